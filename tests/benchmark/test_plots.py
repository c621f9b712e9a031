from __future__ import annotations

import re

from thinkgrasp.benchmark.plots import histograms


def test_a_single_failure_beside_many_successes_is_drawn():
    svg = histograms({"offline": [(0, 0), (147, 0), (0, 1)]}, "Grasps", "grasps")
    assert "2 grasps: 0 solved, 1 failed" in svg
    assert all(float(height) > 0 for height in re.findall(r'<rect [^>]*height="([^"]+)"', svg))
