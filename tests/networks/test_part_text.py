"""Names as sentences, vectors kept on disk, and tables of fixed names."""

from __future__ import annotations

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")
pytest.importorskip("transformers", reason="needs thinkgrasp[langsam]")

from fakes.vlpart import golden, save_tokenizer, tower_weights  # noqa: E402

from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.networks.clip_text import ClipText  # noqa: E402
from thinkgrasp.networks.part_text import BACKGROUND, EncodedText, TextTable, sentence, split_vocabulary  # noqa: E402


@pytest.fixture(scope="module")
def tower(tmp_path_factory) -> ClipText:
    folder = tmp_path_factory.mktemp("tokenizer")
    return ClipText(tower_weights(save_tokenizer(folder)), tokenizer=folder)


class Counting:
    """A tower that says how many sentences it has encoded."""

    def __init__(self, tower: ClipText) -> None:
        self._tower, self.encoded = tower, 0
        self.digest, self.width, self.token_ids = tower.digest, tower.width, tower.token_ids

    def encode(self, ids):
        self.encoded += len(ids)
        return self._tower.encode(ids)


@pytest.mark.parametrize(
    ("vocabulary", "sentences"),
    [
        ("mug:handle.Mug:Body.knife", ["a mug handle", "a mug body", "a knife"]),
        ("dog head. dog nose", ["a dog head", "a  dog nose"]),
        ("pan_(for_cooking):handle.", ["a pan_(for_cooking) handle"]),
        ("..", []),
        ("", []),
    ],
)
def test_a_vocabulary_becomes_sentences(vocabulary, sentences):
    assert [sentence(name) for name in split_vocabulary(vocabulary)] == sentences


def test_sentences_are_the_originals():
    meta = json.loads(str(golden("golden_vlpart")["meta_json"]))
    names = split_vocabulary(meta["text_prompt"])
    assert [*(sentence(n) for n in names), BACKGROUND] == meta["captions"]
    g = golden("golden_text")
    names = json.loads(str(g["rn50/names_json"]))
    assert [sentence(n) for n in names] == json.loads(str(g["rn50/sentences_json"]))
    assert [sentence(n) for n in split_vocabulary(str(g["tok/vocabulary"]))] == json.loads(str(g["tok/texts_json"]))[
        :11
    ]


def test_a_sentence_is_encoded_once_for_all_processes(tower, tmp_path):
    first, second = Counting(tower), Counting(tower)
    wanted = EncodedText(first, tmp_path).features(["a mug", "a knife", "a mug"])  # type: ignore[arg-type]
    assert first.encoded == 2
    assert len(list(tmp_path.iterdir())) == 2
    torch.testing.assert_close(wanted[0], wanted[2], atol=0, rtol=0)
    text = EncodedText(second, tmp_path)  # type: ignore[arg-type]
    assert torch.equal(text.features(["a mug", "a knife"]), wanted[:2])
    assert second.encoded == 0
    text.features(["a mug handle"])
    assert second.encoded == 1
    assert text.notes() == ()


@pytest.mark.parametrize(
    "damage",
    [
        lambda p: p.write_bytes(b""),
        lambda p: p.write_bytes(p.read_bytes()[:-30]),
        lambda p: p.write_bytes(b"garbage" * 20),
        lambda p: np.save(p, np.zeros(3, np.float32)),
        lambda p: np.save(p, np.full(24, np.nan, np.float32)),
        lambda p: np.save(p, np.array([{"a": 1}]), allow_pickle=True),
    ],
)
def test_a_damaged_file_is_computed_again_and_said(tower, tmp_path, damage):
    wanted = EncodedText(tower, tmp_path).features(["a mug"])
    (file,) = tmp_path.iterdir()
    damage(file)
    text = EncodedText(tower, tmp_path)
    assert torch.equal(text.features(["a mug"]), wanted)
    (note,) = text.notes()
    assert str(file) in note
    assert text.notes() == ()
    assert torch.equal(torch.from_numpy(np.load(file)), wanted[0])


def test_other_weights_have_other_files(tower, tmp_path):
    EncodedText(tower, tmp_path).features(["a mug"])
    other = Counting(tower)
    other.digest = "another"
    EncodedText(other, tmp_path).features(["a mug"])  # type: ignore[arg-type]
    assert other.encoded == 1


def test_a_folder_that_cannot_be_made(tower, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cache folder"):
        EncodedText(tower, tmp_path / "file" / "cache")


def test_without_a_folder_it_is_kept_in_memory(tower):
    counting = Counting(tower)
    text = EncodedText(counting, None)  # type: ignore[arg-type]
    assert torch.equal(text.features(["a mug"]), text.features(["a mug"]))
    assert counting.encoded == 1


def save_table(path, names, features) -> None:
    np.savez(path, names=np.array(names), features=features)


def test_a_table_answers_its_own_names_only(tmp_path):
    rows = np.random.default_rng(0).normal(size=(3, 24)).astype(np.float16)
    save_table(tmp_path / "t.npz", ["mug:handle", "bus:license plate", "background"], rows)
    table = TextTable(tmp_path / "t.npz")
    assert table.width == 24
    got = table.features(["a mug handle", "a  mug handle", BACKGROUND])
    np.testing.assert_array_equal(got, rows[[0, 0, 2]].astype(np.float32))
    with pytest.raises(InputError, match=r"'a mug handel' is not among the 3 names .*near it are a mug handle"):
        table.features(["a mug handel"])


def test_a_table_need_not_know_the_background(tmp_path):
    save_table(tmp_path / "t.npz", ["mug"], np.ones((1, 4), np.float32))
    assert TextTable(tmp_path / "t.npz").features(["a mug", BACKGROUND])[1].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: None, "does not exist"),
        (lambda p: p.write_bytes(b"no table"), "is no table"),
        (lambda p: np.savez(p, features=np.ones((1, 2))), "is no table"),
        (lambda p: save_table(p, ["a", "b"], np.ones((1, 2), np.float32)), "needs names"),
        (lambda p: save_table(p, [], np.ones((0, 2), np.float32)), "needs names"),
        (lambda p: save_table(p, ["a"], np.full((1, 2), np.inf)), "needs names"),
        (lambda p: save_table(p, [1], np.ones((1, 2))), "needs names"),
        (lambda p: np.savez(p, names=np.array([{}]), features=np.ones((1, 2))), "is no table"),
    ],
)
def test_a_bad_table_is_named(tmp_path, write, message):
    path = tmp_path / "t.npz"
    write(path)
    with pytest.raises(ConfigError, match=message) as error:
        TextTable(path)
    assert str(path) in str(error.value)
