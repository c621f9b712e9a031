from __future__ import annotations

import random
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest
from fakes import benchmark_results as made

from thinkgrasp.benchmark import published
from thinkgrasp.benchmark.comparison import compare
from thinkgrasp.benchmark.document import Table, table_lines
from thinkgrasp.benchmark.records import CRASHED, EpisodeRecord
from thinkgrasp.benchmark.report import write_report
from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.types import Usage

FRUIT, PEAR = made.TASKS
METHODS = ("offline", "oracle", "vlm@1", "vlm@0.5", "random-object")
RATES = dict(zip(METHODS, (0.9, 1.0, 0.9, 0.6, 0.3), strict=True))


@pytest.fixture(scope="module")
def full(tmp_path_factory) -> Path:
    plan = made.plan(METHODS, 5)
    folder = made.write(tmp_path_factory.mktemp("full"), plan, made.made_up(plan, RATES))
    write_report((folder,))
    return folder


def small(folder: Path, *episodes, methods=("offline",), runs=1, **of) -> Path:
    scenes = [made.scene(task) for task in made.TASKS]
    return made.write(folder, made.plan(methods, runs, **of), [*scenes, *(r for e in episodes for r in e)])


def test_what_the_terminal_shows(tmp_path):
    folder = small(tmp_path, made.episode(1), made.episode(3, False, task=PEAR))
    lines = write_report((folder,)).splitlines()
    assert [cell.strip() for cell in lines[2].split("|")[1:-1]] == [
        "offline", "1/2", "0.500", "0.095 to 0.905", "2.00", "8.00", "1.00", "reference"
    ]  # fmt: skip
    assert "clutter-v1: 2 of 2 planned episodes are finished." in lines
    assert lines[-1].startswith("report: ")
    assert {"report.md", "report.html", "rows.tex"} <= {path.name for path in folder.iterdir()}


def test_an_unfinished_folder_says_how_much_of_it_is_there(tmp_path):
    folder = small(tmp_path, made.episode(1), methods=("offline", "oracle"), runs=3)
    with (folder / "records.jsonl").open("ab") as file:
        file.write(b'{"kind":"step","method":"orac')
    told = write_report((folder,))
    assert "1 of 12 planned episodes are finished; unfinished: offline 1 of 6, oracle 0 of 6." in told
    assert "1 of 12 planned" in (folder / "report.md").read_text()
    assert "1 of 12 planned" in (folder / "rows.tex").read_text()


def test_the_report_has_every_part(full):
    text = (full / "report.md").read_text()
    for part in (
        "Success and grasps", "Against offline, pile by pile", "Grasps over the fewest possible", "How episodes ended",
        "Obstruction reasoning", "Grasps, wrong objects, damage", "What failed episodes failed of",
        "Failures of vlm@0.5", "Time of a step [ms]", "What the model cost", "Fallbacks taken", "Solved by task",
        "The paper's clutter averages", "What may be compared", "thinkgrasp bench run --again",
        "code 0123456789ab", "Seeds 1000 to 1004", "numpy 2.0",
        "![Share of episodes not yet solved](plots/clutter-v1-unsolved.svg)", "its end competes with success",
    ):  # fmt: skip
        assert part in text, part
    assert "Warning" not in text


def test_the_order_of_the_records_does_not_matter(full, tmp_path):
    plan = made.plan(METHODS, 5)
    blocks: dict[object, list[object]] = {}
    for record in made.made_up(plan, RATES):
        blocks.setdefault(("scene", record.key) if record.kind == "scene" else record.key, []).append(record)
    shuffled = list(blocks.values())
    random.Random(1).shuffle(shuffled)
    folder = made.write(tmp_path, plan, [record for block in shuffled for record in block])
    write_report((folder,))
    for name in ("report.md", "report.html", "rows.tex"):
        assert (folder / name).read_text().replace(str(folder), "") == (full / name).read_text().replace(str(full), "")


class _Page(HTMLParser):
    """Checks that elements are closed in order; notes what is loaded and how cells are headed."""

    VOID = frozenset({"meta", "link", "br", "hr", "img"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []
        self.tables: list[dict[str, int]] = []

    def handle_startendtag(self, tag, attrs):
        self.note(tag, attrs)

    def handle_starttag(self, tag, attrs):
        self.note(tag, attrs)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def note(self, tag, attrs):
        self.loads += [value for name, value in attrs if name in ("src", "href", "data", "srcset", "xlink:href")]
        assert tag not in ("script", "iframe", "object", "embed")
        if tag == "table":
            self.tables.append({"caption": 0, "col": 0, "row": 0})
        elif tag == "caption":
            self.tables[-1]["caption"] += 1
        elif tag == "th":
            self.tables[-1][dict(attrs)["scope"]] += 1


def test_the_page_is_well_formed_and_loads_nothing(full):
    text = (full / "report.html").read_text()
    page = _Page()
    page.feed(text)
    page.close()
    assert page.open == []
    assert all(target.startswith(("#", "data:")) for target in page.loads)
    assert "url(" not in text
    assert "@import" not in text
    assert len(page.tables) >= 12
    assert all(table["caption"] == 1 and table["col"] >= 2 and table["row"] >= 1 for table in page.tables)
    assert "prefers-color-scheme: dark" in text
    plots = [ElementTree.fromstring(part.split("</svg>")[0] + "</svg>") for part in
             ("<svg" + rest for rest in text.split("<svg")[1:])]  # fmt: skip
    assert len(plots) == 5, "success, accuracy, grasps, not yet solved, failures"
    assert all(plot.get("role") == "img" and plot.get("aria-label") for plot in plots)


def test_plots_stand_alone(full):
    named = set(re.findall(r"\]\(plots/(.+?)\)", (full / "report.md").read_text()))
    files = {path.name: path.read_text() for path in (full / "plots").iterdir()}
    assert set(files) == named
    assert len(named) == 5
    for svg in files.values():
        ElementTree.fromstring(svg)
        assert "var(" not in svg
        assert "class=" not in svg


def test_words_of_a_plan_are_no_markup(tmp_path):
    failed = [made.step(1, target="<b>&apple</b>", status="no_grasp", reason=None)]
    episode = EpisodeRecord("offline", FRUIT, 1000, False, "no_grasp", 0)
    folder = small(tmp_path, failed, [episode])
    write_report((folder,))
    assert "&lt;b&gt;&amp;apple&lt;/b&gt;" in (folder / "report.html").read_text()


def test_latex_rows(tmp_path):
    episodes = (made.episode(1), made.episode(3, False, task=PEAR), made.episode(2, method="oracle"))
    write_report((small(tmp_path, *episodes, methods=("offline", "oracle")),))
    rows = [line for line in (tmp_path / "rows.tex").read_text().splitlines() if r"\\" in line]
    assert rows == [
        r"I need a fruit & 1.000 & 1.00 & 1.00 & 1.000 & 2.00 & 2.00 \\ % clutter-06-fruit",
        r"I need a fruit & 0.000 & 3.00 & -- & -- & -- & -- \\ % clutter-09-pear",
        r"Average & 0.500 & 2.00 & 1.00 & 1.000 & 2.00 & 2.00 \\",
    ]


def test_two_states_of_the_code_and_crashes_are_warned_of(tmp_path):
    crashed = [EpisodeRecord("offline", PEAR, 1000, False, CRASHED, 0, error="RuntimeError: no\nlong")]
    plan = made.plan(runs=1)
    plan = replace(plan, sessions=(*plan.sessions, *made.plan(source="fedcba987654").sessions))
    folder = made.write(tmp_path, plan, [made.scene(), *made.episode(1), *crashed])
    told = write_report((folder,))
    assert "warning: The results come from 2 states of the code (0123456789ab, fedcba987654)" in told
    assert "warning: Episodes that crashed count as failures: offline 1." in told
    assert 'class="warning"' in (folder / "report.html").read_text()
    assert "RuntimeError: no" in (folder / "report.md").read_text()


def test_costs(tmp_path):
    asked, unknown = Usage("m", 1000, 50, 0.02, 2), Usage("m", 1000, 50, None, 2)
    folder = small(
        tmp_path, made.episode(2), made.episode(2, method="vlm", usage=asked),
        made.episode(2, method="vlm-only", usage=unknown), methods=("offline", "vlm", "vlm-only"),
    )  # fmt: skip
    write_report((folder,))
    text = (folder / "report.md").read_text()
    rows = [line for line in text[text.index("What the model cost") :].splitlines() if line.startswith("|")][2:5]
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    assert cells == [
        ["offline", "none asked", "-", "-", "-", "-"],
        ["vlm", "2.0", "1000 + 50", "500 + 25", "0.0200", "0.0100"],
        ["vlm-only", "2.0", "1000 + 50", "500 + 25", "not known", "not known"],
    ]


def test_folders_of_one_suite_with_other_methods_make_one_table(tmp_path):
    a = small(tmp_path / "a", made.episode(1), made.episode(2, task=PEAR))
    b = small(tmp_path / "b", made.episode(4, method="oracle"), methods=("oracle",))
    told = write_report((a, b, a), "oracle")
    assert "3 of 4 planned episodes are finished; unfinished: oracle 1 of 2." in told
    assert not (b / "report.md").exists()
    assert "Against oracle" in (a / "report.md").read_text()
    c = small(
        tmp_path / "c", made.episode(9, False, task="heavy-04-fruit"), tasks=("heavy-04-fruit",), suite="heavy-v1"
    )
    told = write_report((c, a, b), "oracle")
    assert "failures as 50" in told
    assert "failures as 15" in told
    assert "heavy-v1 has no results of oracle; its reference is offline." in (c / "report.md").read_text()


def test_what_does_not_fit_together(tmp_path):
    a = small(tmp_path / "a", made.episode(1))
    with pytest.raises(ConfigError, match=r"'magic'.*there are offline"):
        write_report((a,), "magic")
    other = made.write(
        tmp_path / "b", made.plan(("oracle",), 1), [made.scene(n_objects=5), *made.episode(1, method="oracle")]
    )
    with pytest.raises(InputError, match=r"other piles for clutter-06-fruit seed 1000: 9 objects .* 5 objects"):
        write_report((a, other))
    again = small(tmp_path / "c", made.episode(2))
    with pytest.raises(InputError, match="other results of offline clutter-06-fruit 1000; `bench compare`"):
        write_report((a, again))
    assert not (a / "report.md").exists()


def test_folders_that_hold_nothing(tmp_path):
    with pytest.raises(InputError, match="is no folder"):
        write_report((tmp_path / "none",))
    with pytest.raises(InputError, match="folder of a benchmark"):
        write_report((tmp_path,))
    with pytest.raises(InputError, match="no episode of clutter-v1 is finished yet"):
        write_report((small(tmp_path / "new"),))


def test_compare_same_results(tmp_path, full):
    plan = made.plan(METHODS, 5)
    again = made.write(tmp_path, plan, made.made_up(plan, RATES))
    told = compare(full, again)
    assert "plan and versions are the same" in told
    assert "episodes whose result changed: 0" in told
    assert "same results: all 50 episodes that both hold are identical step by step, apart from times" in told


def test_compare_says_what_differs(tmp_path):
    a = small(tmp_path / "a", made.episode(1), made.episode(2, task=PEAR), methods=("offline", "oracle"))
    b = small(tmp_path / "b", made.episode(1), made.episode(3, False, task=PEAR), source="fedcba987654")
    told = compare(a, b)
    assert "- code: A 0123456789ab, B fedcba987654" in told
    assert "- method only in A: oracle" in told
    assert "- offline clutter-09-pear seed 1000: goal_delivered after 2, now step_limit after 3" in told
    assert "of 2 episodes and their piles that both hold, 1 differ in more than times:" in told
    assert "only in A" not in told.replace("only in A: oracle", "")
    row = next(line for line in told.splitlines() if line.startswith("| offline"))
    assert [cell.strip() for cell in row.split("|")[4:6]] == ["2", "1 / 0"]
    c = small(tmp_path / "c", made.episode(1, task="heavy-04-fruit"), tasks=("heavy-04-fruit",), suite="heavy-v1")
    with pytest.raises(InputError, match="no pile in common"):
        compare(a, c)


def test_published_rates_are_whole_episodes():
    counts = {p.method: (p.count("clutter"), p.count("heavy")) for p in published.TABLE}
    assert counts["ThinkGrasp"] == ((147, 150), (71, 90))
    assert counts["OVGrasp"] == (None, (0, 90)), "0.438 is no whole number of 150"
    assert all(all(count) for method, count in counts.items() if method != "OVGrasp")


def test_table_lines_escape_and_align():
    lines = table_lines(Table("t", ("a", "b"), (("x|y", "1"), ("z", "long"))))
    assert lines == ["| a    | b    |", "|------|------|", r"| x\|y | 1    |", "| z    | long |"]
