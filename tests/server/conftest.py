"""The fuzz run is long, so that it runs only where it is asked for: `make fuzz`, or pytest -m fuzz."""

from __future__ import annotations

import pytest


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if "fuzz" in config.getoption("-m"):
        return
    for item in items:
        if item.get_closest_marker("fuzz"):
            item.add_marker(pytest.mark.skip(reason="thousands of requests: run by make fuzz"))
