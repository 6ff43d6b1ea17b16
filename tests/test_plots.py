"""Figures: what is in them, and whether it can be read."""

from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.text import Text
from PIL import Image

from jaxdyna.experiments.report import frames, plots

STANDARD = ("model_free", "dyna", "placebo", "oracle", "more_updates", "max_updates")


@pytest.fixture
def figures(monkeypatch):
    kept = []
    monkeypatch.setattr(plots, "save", lambda figure, path: kept.append(figure))
    return kept


def test_all_arms_are_in_one_panel_as_smooth_as_each_other(figures, tmp_path):
    returns = {"model_free": np.arange(24.0).reshape(6, 4), "dyna": np.ones((6, 4))}
    solved = {"model_free": np.full(6, np.inf), "dyna": np.full(6, 2.0)}
    plots.learning_curves(tmp_path / "a.png", returns, 1.0, solved, {"dreams begin": 2}, 2)
    (panel,) = figures[0].axes
    drawn = {line.get_label(): line.get_ydata() for line in panel.lines}
    assert drawn["model_free: 0/6 solved"].tolist() == [10, 10.5, 11.5, 12.5]
    assert drawn["dyna: 6/6 solved, mean 2"].tolist() == [1, 1, 1, 1]
    assert "dreams begin: 2" in drawn and figures[0].get_figwidth() == plots.WIDTH


def test_a_panel_in_which_nothing_varies_is_left_out_and_a_figure_of_such_ones(figures, tmp_path):
    path, flat, steep = tmp_path / "a.png", np.zeros((6, 3)), np.arange(18.0).reshape(6, 3)
    path.write_bytes(b"an earlier one")
    assert not plots.bands(path, {"flat": {"dyna": flat, "oracle": flat}}, "x")
    assert not path.exists() and not figures
    assert plots.bands(path, {"flat": {"dyna": flat}, "steep": {"dyna": steep}}, "x")
    assert [panel.get_title(loc="left") for panel in figures[0].axes] == ["steep"]
    unsolved = {"a": np.full(3, np.inf), "b": np.full(3, np.inf)}
    assert not plots.solve_bars(path, unsolved, 10, "episodes")
    assert plots.solve_bars(path, unsolved | {"c": np.array([3.0, 4, 5])}, 10, "episodes")


def test_standard_arms_differ_in_colour_in_dashes_or_lightness_as_well():
    """A colour-blind eye tells Okabe and Ito's apart; where two are of one lightness, as grey
    paper has them, dashes differ.
    """
    for one, other in combinations([plots.look(name) for name in STANDARD], 2):
        light = [np.dot(to_rgb(each.color), (0.3, 0.59, 0.11)) for each in (one, other)]
        assert one.color != other.color
        assert abs(light[0] - light[1]) > 0.1 or one.linestyle != other.linestyle


def test_lines_that_would_look_alike_get_others():
    names = [f"dyna@learning_rate={rate}" for rate in range(9)]
    assert len(set(plots.looks(names))) == 9 and plots.looks(["dyna"]) == [plots.LOOKS["dyna"]]


def test_an_arm_that_comes_twice_keeps_its_colour():
    twice = ["model_free", "dyna, one", "dyna, two", "placebo, two"]
    first, one, other, placebo = plots.looks(twice)
    assert (first, one, placebo) == tuple(plots.look(name) for name in (twice[0], *twice[1::2]))
    assert other.color == one.color and other.linestyle != one.linestyle
    own = plots.looks(["model_free", "mine", "mine, two", "dyna"])  # colours tell these
    assert len({look.color for look in own}) == 4


def test_labels_of_points_that_lie_close_do_not_cover_each_other():
    figure, panel = plots.subplots(figsize=(plots.WIDTH, 4))
    points = {str(number): (1 + number / 1000, 1.0) for number in range(12)} | {"12": (2.0, 2.0)}
    panel.plot(*zip(*points.values(), strict=True), "o")
    figure.draw_without_rendering()
    plots.apart(panel, points)
    figure.draw_without_rendering()
    boxes = [Text.get_window_extent(text) for text in panel.texts]  # without their lines
    assert len(boxes) == 13
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def test_a_film_is_no_wider_than_a_page_and_its_captions_can_be_read(tmp_path):
    film = [(np.zeros((16, 16, 3), np.uint8), f"step {number}") for number in range(2)]
    frames.film(tmp_path / "a.gif", {f"episode {number}": film for number in range(7)})
    with Image.open(tmp_path / "a.gif") as picture:
        (width, height), grey = picture.size, np.asarray(picture.convert("L"))
    assert width <= frames.PAGE and (width + 12) % 3 == 0 and height > 3 * 256
    head = grey[:20, :200]
    rows = np.flatnonzero((head < 128).any(1))
    assert rows[-1] - rows[0] >= 13  # from the tallest letter's top to the lowest one's end


def test_bands_by_orders_of_magnitude_stay_above_zero(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plots, "save", lambda figure, path: drawn.append(figure))
    values = np.exp(4 * np.random.default_rng(0).normal(size=(10, 30)))
    for log in (False, True):
        assert plots.bands(tmp_path / "a.png", {"": {"dyna": values}}, "x", log=log)
    lowest = [figure.axes[0].collections[0].get_paths()[0].vertices[:, 1].min() for figure in drawn]
    assert lowest[0] < 0 < lowest[1] < values.mean(0).min()
    assert [figure.axes[0].get_yscale() for figure in drawn] == ["linear", "log"]
