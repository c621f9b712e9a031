from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from fakes.arm_scene import Scene


@pytest.fixture
def scene(monkeypatch) -> Iterator[Scene]:
    from fakes.arm_scene import Scene

    made = Scene(monkeypatch)
    yield made
    for robot in made.robots:
        robot.close()
    made.lab.close()
