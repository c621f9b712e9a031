"""Plug-ins are found, loaded and refused with messages that help."""

from __future__ import annotations

import importlib.metadata
from importlib.metadata import EntryPoint

import pytest
from fakes.stages import FakePlanner

from thinkgrasp import registry
from thinkgrasp.errors import ConfigError, ContractError, PluginNotFound


@pytest.fixture
def offer(monkeypatch):
    """Offer entry points beside the installed ones."""
    extra: list[EntryPoint] = []
    original = importlib.metadata.entry_points

    def entry_points(*, group: str):
        return [*original(group=group), *(p for p in extra if p.group == group)]

    monkeypatch.setattr(registry, "entry_points", entry_points)

    def add(kind: str, name: str, value: str) -> None:
        extra.append(EntryPoint(name, value, f"thinkgrasp.{kind}"))

    return add


def test_built_in_stages_take_the_same_route():
    assert "offline" in registry.available("planner")
    assert "antipodal" in registry.available("generator")
    assert list(registry.available("check")) == sorted(registry.available("check"))


def test_settings_reach_the_constructor(offer):
    offer("planner", "fake", "fakes.stages:FakePlanner")
    planner = registry.load("planner", "fake", grid=5, cell=7)
    assert (planner.grid, planner.cell) == (5, 7)
    assert type(planner).__name__ == FakePlanner.__name__


def test_a_wrong_name_gets_a_suggestion():
    with pytest.raises(PluginNotFound, match=r"no planner named 'ofline'; installed: .*Did you mean 'offline'\?"):
        registry.load("planner", "ofline")


def test_a_name_like_nothing_gets_the_list():
    with pytest.raises(PluginNotFound, match="installed: antipodal"):
        registry.load("generator", "zzz")


def test_unknown_kind():
    with pytest.raises(ConfigError, match="unknown plug-in kind 'brain'; kinds are scene, planner"):
        registry.available("brain")  # type: ignore[arg-type]


def test_two_packages_with_one_name(offer):
    offer("planner", "twice", "fakes.stages:FakePlanner")
    offer("planner", "twice", "fakes.stages:FakeScene")
    with pytest.raises(ConfigError, match="two packages offer the planner 'twice'"):
        registry.load("planner", "twice")


def test_the_same_entry_twice_is_no_collision(offer):
    offer("planner", "same", "fakes.stages:FakePlanner")
    offer("planner", "same", "fakes.stages:FakePlanner")
    assert registry.load("planner", "same")


@pytest.mark.parametrize("value", ["no_such_module:Planner", "fakes.stages:NoSuchName"])
def test_broken_entry(offer, value):
    offer("planner", "broken", value)
    with pytest.raises(ConfigError, match=r"planner 'broken' .* cannot be imported"):
        registry.load("planner", "broken")


def test_unknown_setting(offer):
    offer("planner", "fake", "fakes.stages:FakePlanner")
    with pytest.raises(ConfigError, match=r"does not take the settings \['gird'\].*gird"):
        registry.load("planner", "fake", gird=4)


def test_wrong_kind_of_object(offer):
    offer("planner", "wrong", "fakes.stages:FakeScene")
    with pytest.raises(ContractError, match="made FakeScene, which lacks the methods of the planner contract"):
        registry.load("planner", "wrong")
