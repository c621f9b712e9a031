"""Questions to a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thinkgrasp.planners.vlm.chat import Question


def test_digests_depend_on_what_is_asked_alone():
    image = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    question = Question("m", "s", "t", image, schema={"a": 1, "b": 2})
    assert question.digest == replace(question, image=image[:, ::-1][:, ::-1], schema={"b": 2, "a": 1}).digest
    others = [replace(question, text="u"), question.again("r", "p"), replace(question, image=image.reshape(2, 8, 3))]
    assert len({question.digest, *(o.digest for o in others)}) == 4
