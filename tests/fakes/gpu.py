"""A mark for what only a machine with a GPU can show."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
