"""The heat maps of how alike tasks are."""

import builtins

import pytest
from helpers.oracles import surjective

import curricula
from ctgraph_rl.draw import similarity_figure
from ctgraph_rl.draw.similarity_figure import draw_similarity
from ctgraph_rl.tasks.curriculum import Curriculum
from ctgraph_rl.tasks.protocol import Block

GOALS = [(1, 1), (1, 2), (2, 2)]


@pytest.mark.parametrize("num_tasks", [1, *(pytest.param(num, marks=pytest.mark.slow) for num in (3, 41))])
def test_the_heat_maps_are_drawn_for_few_and_many_tasks(tmp_path, num_tasks):
    blocks = tuple(Block(surjective(goal=GOALS[i % 3], image_seed=i), 1) for i in range(num_tasks))

    draw_similarity(Curriculum("c", 1, "", blocks), tmp_path / "map.png")

    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_tasks_are_named_left_of_each_row_and_below_each_column_of_maps(monkeypatch):
    drawn = []
    monkeypatch.setattr(similarity_figure, "save_figure", lambda figure, path: drawn.append(figure))

    draw_similarity(curricula.load("su_b1_4tasks"), "map.png")

    maps = drawn[0].axes[:5]
    assert [len(axes.get_yticklabels()) for axes in maps] == [4, 0, 0, 4, 0]
    assert [len(axes.get_xticklabels()) for axes in maps] == [0, 0, 4, 4, 4]


def test_without_matplotlib_the_extra_is_named(tmp_path, monkeypatch):
    import_ = builtins.__import__

    def without(name: str, *rest: object) -> object:
        if name.startswith("matplotlib"):
            raise ModuleNotFoundError(name)
        return import_(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)

    with pytest.raises(ModuleNotFoundError, match=r"figures need matplotlib: pip install 'ctgraph_rl\[plot\]'"):
        draw_similarity(curricula.load("su_b1_4tasks"), tmp_path / "map.png")
