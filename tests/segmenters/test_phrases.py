"""Which tokens of a caption are whose: by place, never by likeness."""

from __future__ import annotations

import re

import pytest

from thinkgrasp.segmenters.phrases import Caption, clean, unread


def words(text: str) -> list[tuple[int, int]]:
    """A token per word and per punctuation mark, between two that stand for nothing."""
    return [(0, 0), *(m.span() for m in re.finditer(r"\w+|[^\w\s]", text)), (0, 0)]


@pytest.mark.parametrize(
    ("phrase", "cleaned"),
    [
        ("Red Mug", "red mug"),
        ("  a\n mug ", "a mug"),
        ("a mug.", "a mug"),
        ("mug. knife", "mug knife"),
        ("which one?", "which one"),
        ("...", ""),
        ("", ""),
        ("7-up", "7-up"),
    ],
)
def test_clean(phrase, cleaned):
    assert clean(phrase) == cleaned


def test_the_caption_is_what_grounding_dino_expects():
    assert Caption.of(["A mug", "red box"]).text == "a mug. red box."
    assert Caption.of(["mug"]).text == "mug."


@pytest.mark.parametrize(
    "phrases", [["mug"], ["red mug", "mug"], ["mug", "red mug", "mug handle"], ["cup", "cupboard", "up"], ["a. b", "b"]]
)
def test_each_phrase_owns_its_own_words_and_no_others(phrases):
    caption = Caption.of(phrases)
    offsets = words(caption.text)
    owned = caption.tokens(offsets)
    said = [[caption.text[slice(*offsets[i])] for i in tokens] for tokens in owned]
    assert said == [clean(phrase).split() for phrase in phrases]
    flat = [i for tokens in owned for i in tokens]
    assert len(flat) == len(set(flat))


def test_word_pieces_belong_to_their_word_and_full_stops_to_no_one():
    caption = Caption.of(["mugs", "box"])
    offsets = [(0, 0), (0, 3), (3, 4), (4, 5), (6, 7), (7, 9), (9, 10), (0, 0)]
    assert caption.tokens(offsets) == ((1, 2), (4, 5))


def test_what_was_cut_off_owns_nothing():
    assert Caption.of(["mug", "box"]).tokens([(0, 0), (0, 3), (3, 4), (0, 0)]) == ((1,), ())
    assert Caption.of([""]).tokens([(0, 0), (0, 1), (0, 0)]) == ((),)


@pytest.mark.parametrize(
    ("text", "offsets", "rest"),
    [
        ("red mug.", [(0, 0), (0, 3), (4, 7), (7, 8), (0, 0)], ""),
        ("red mug.", [(0, 0), (0, 3), (4, 7), (0, 0)], ""),
        ("red mug.", [(0, 0), (0, 3), (0, 0)], "mug"),
        ("red mugs.", [(0, 0), (0, 3), (4, 7), (0, 0)], "s"),
        ("red mug.", [], "red mug"),
        ("", [(0, 0)], ""),
        ("a " + 80 * "b", [(0, 1)], 60 * "b" + "..."),
    ],
)
def test_what_was_not_read(text, offsets, rest):
    assert unread(text, offsets) == rest
