"""``report.html``: whole, small, closed to the outside, and true to the curves."""

import base64
import gzip
import json
import shutil
import subprocess
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from jaxdyna.experiments.report import frames, page, plots
from jaxdyna.statistics import SolveRule

ODD = "dyna@a</script>b&c='d'"


class Read(HTMLParser):
    """Every tag's attributes, and the text outside script and style."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self.inside = [], "", []
        self.scripts = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.inside.append(tag)

    def handle_endtag(self, tag):
        while self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data):
        last = self.inside[-1] if self.inside else ""
        if last == "script":
            self.scripts.append(data)
        elif last != "style":
            self.text += data

    def of(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def record(out, arms=("model_free", "dyna"), runs=3, episodes=40, **more):
    generator = np.random.default_rng(0)

    def one():
        returns = generator.normal(size=(runs, episodes)).cumsum(1)
        returns[0, episodes - 5 :] = np.nan  # over before the others
        return {"real_return": returns, "alike": np.ones_like(returns)} | {
            name: make(generator, returns) for name, make in more.items()
        }

    results = {"runs": {"seeds": list(range(7, 7 + runs))}}
    return SimpleNamespace(curves={arm: one() for arm in arms}, results=results, out=out)


def unpacked(told):
    """By measure and arm ``[3 + runs, points]``, values again."""
    steps = np.frombuffer(gzip.decompress(base64.b64decode(told["packed"])), "<i2")
    found, at = {}, 0
    for measure in told["measures"]:
        low, high = measure["lowest"], measure["highest"]
        for arm, points, runs in measure["arms"]:
            count = (3 + runs) * points
            heights = steps[at : at + count].reshape(3 + runs, points).cumsum(1)
            at += count
            share = np.where(heights < 0, np.nan, heights / told["heights"])
            found[measure["name"], told["arms"][arm]["name"]] = (
                low * (high / low) ** share if measure["orders"] else low + (high - low) * share
            )
    assert at == len(steps)
    return found


def test_the_page_is_whole_and_loads_nothing(tmp_path):
    made = record(tmp_path, ("model_free", ODD))
    figure, panel = plots.subplots(figsize=(plots.WIDTH, 4))
    panel.plot([1, 2], label="a")
    plots.save(figure, tmp_path / "returns.png")
    frames.film(tmp_path / "film.gif", {"episode": [(np.zeros((4, 4, 3), np.uint8), "")] * 2})
    text = (
        "# A <b> & co\n\n`it --arms 'a<b'`\n\n**Bold** <img src=x> [more](report.md)\n\n"
        f"| arm | is |\n| --- | --- |\n| {ODD} | 5 |\n\n![of <i>](returns.png)\n\n"
        "![a film](film.gif)\n\n![outside](https://example.org/a.png)\n\n## Settings\n"
    )
    html = page.page(made, text)
    read = Read(html)
    assert not read.inside or read.inside == ["html"]
    assert "A <b> & co" in read.text and "it --arms 'a<b'" in read.text
    assert ODD in read.text and "<img src=x>" in read.text and "Settings" in read.text
    assert [tag for tag, _ in read.tags].count("table") == 1 and "b" not in dict(read.tags)
    policy = next(one for one in read.of("meta") if "http-equiv" in one)
    assert policy["content"].startswith("default-src 'none'; img-src data:;")
    pictures = read.of("img")
    kinds = [one["src"].partition(";")[0] for one in pictures]
    assert kinds == ["data:image/webp", "data:image/gif", ""]  # what is not in the folder: nothing
    assert [one["alt"] for one in pictures] == ["of <i>", "a film", "outside"]
    film = base64.b64decode(pictures[1]["src"].partition(",")[2])
    assert film == (tmp_path / "film.gif").read_bytes()
    loads = [value for tag, attrs in read.tags for name, value in attrs.items()
             if name in ("src", "href", "srcset", "action") and tag != "a"]  # fmt: skip
    assert all(value.startswith("data:") or not value for value in loads)
    assert "http" not in html.replace("http-equiv", "")
    told = json.loads(read.scripts[0])
    assert [one["name"] for one in told["arms"]] == ["model_free", ODD]
    assert told["runs"] == [7, 8, 9] and "</" not in read.scripts[0]


def test_what_is_drawn_are_the_curves(tmp_path):
    """Means, ends of what is shaded, and single runs, to a thousandth of what is between the
    lowest and the highest; what never varies is not drawn, and a run that is over keeps its value.
    """
    made = record(tmp_path, model_error=lambda generator, returns: 10.0 ** (2 * returns))
    made.curves["dyna"]["model_error"][:, :9] = np.nan  # before there is a model
    told = page.curves(made)
    assert told["episodes"] == list(range(1, 41)) and told["window"] == 4
    assert told["shaded"] == "lowest to highest"
    found = unpacked(told)
    assert {name for name, _ in found} == {"real return", "model error"}
    for arm, curves in made.curves.items():
        returns = np.array(curves["real_return"])
        shown = np.array([[run[max(end - 4, 0) : end].mean() for end in range(1, 41)]
                          for run in returns])  # fmt: skip
        shown[0, 35:] = shown[0, 34]
        near = np.nanmax(np.abs(returns)) / 500
        np.testing.assert_allclose(found["real return", arm][3:], shown, atol=near)
        np.testing.assert_allclose(found["real return", arm][0], shown.mean(0), atol=near)
        np.testing.assert_allclose(found["real return", arm][2], shown.max(0), atol=near)
    errors = found["model error", "dyna"]
    assert np.isnan(errors[:, :9]).all() and np.isfinite(errors[:, 9:]).all()
    curve = made.curves["dyna"]["model_error"][1]
    np.testing.assert_allclose(errors[4, 9], curve[9], rtol=0.05)  # drawn by its logarithm
    orders = {one["name"]: one["orders"] for one in told["measures"]}
    assert orders == {"real return": False, "model error": True}


def noise(generator, returns):
    return generator.normal(size=returns.shape)


def test_a_page_of_many_runs_is_small(tmp_path):
    """Larger than they come: curves that compress badly, figures full of dots."""
    kinds = dict.fromkeys(("agent_loss", "model_loss"), noise)
    made = record(tmp_path, [*"abcdef"], 110, 200, **kinds)
    dots = np.random.default_rng(1).integers(0, 255, (500, 1245, 3), np.uint8)
    for name in "ab":
        Image.fromarray(dots).save(tmp_path / f"{name}.png", compress_level=1)
    html = page.page(made, "# Many\n\n![a](a.png)\n\n![b](b.png)\n")
    told = json.loads(Read(html).scripts[0])
    assert len(html) <= 500_000 and len(told["arms"]) == 6 and len(told["runs"]) == 110
    single = [{arm[2] for arm in one["arms"]} for one in told["measures"]]
    assert single == [{100}, {10}, {10}]


def test_a_page_of_very_many_arms_draws_the_first(tmp_path):
    kinds = {f"metric_{number}": noise for number in range(26)}
    made = record(tmp_path, [f"dyna@x={number}" for number in range(60)], 6, 50, **kinds)
    told = page.curves(made)
    assert len(told["arms"]) == 24 and told["more"] == 36
    assert len(told["measures"]) == 23  # and one in which nothing varies
    assert len(json.dumps(told)) <= page.CURVES_BYTES * 1.05
    assert {name for _, name in unpacked(told)} == {arm["name"] for arm in told["arms"]}


def test_what_is_shaded_is_whole_where_no_single_runs_are_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "SIZES", ((40, 3, 0, 9),))
    made = record(tmp_path, ("dyna",), agent_loss=noise,
                  model_error=lambda generator, returns: 10.0 ** (2 * returns))  # fmt: skip
    told = page.curves(made)
    found = unpacked(told)
    for name in ("agent_loss", "model_error"):
        shown = page.smoothed(made.curves["dyna"][name], told["window"])
        lines = found[name.replace("_", " "), "dyna"]
        orders = {one["name"]: one["orders"] for one in told["measures"]}[name.replace("_", " ")]
        assert len(lines) == 3 and orders == (name == "model_error")
        near = {"rtol": 0.05} if orders else {"atol": np.ptp(shown) / 500}
        np.testing.assert_allclose(lines[1], shown.min(0), **near)
        np.testing.assert_allclose(lines[2], shown.max(0), **near)
    made = record(tmp_path, ("dyna",), 8,
                  model_error=lambda generator, returns: 10.0 ** (2 * returns))  # fmt: skip
    (error,) = (one for one in page.curves(made)["measures"] if one["name"] == "model error")
    assert error["orders"] and error["lowest"] > 0  # an interval of its mean begins below 0


def test_the_return_at_which_runs_have_solved_is_a_line(tmp_path):
    made = record(tmp_path, ("dyna",))
    plain, (lined, *rest) = (
        page.curves(made, rule)["measures"] for rule in (None, SolveRule(9, 50.0))
    )
    assert lined["solved"] == 50 and plain[0]["solved"] is None
    assert lined["highest"] == 50 and lined["lowest"] == plain[0]["lowest"]  # there is room for it
    assert all(other["solved"] is None for other in rest)
    assert page.curves(made, SolveRule(9, 50.0))["rule"] == "solved: mean of 9 at 50"
    shares = page.curves(made, SolveRule(9, 0.9, "alike"))
    assert all(measure["solved"] is None for measure in shares["measures"])


def test_a_record_without_episodes_has_no_curves(tmp_path):
    made = SimpleNamespace(curves={"paper@30": {"mass": np.ones((2, 3))}}, out=tmp_path,
                           results={"runs": {"seeds": [0, 1]}})  # fmt: skip
    assert page.curves(made) == {}
    assert page.page(made, "# Frames\n").endswith("</html>\n")


BROWSER = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no browser")
def test_a_browser_draws_the_curves_and_loads_nothing(tmp_path):
    made = record(tmp_path, ("model_free", ODD))
    made.results["runs"]["by"] = "number"
    (tmp_path / "report.html").write_text(page.page(made, "# It\n\nWords.\n"))
    command = [BROWSER, "--headless", "--no-sandbox", "--dump-dom", "--virtual-time-budget=5000"]
    shown = subprocess.run([*command, f"file://{tmp_path}/report.html"], capture_output=True,
                           text=True, check=True)  # fmt: skip
    read = Read(shown.stdout)
    lines = [one["d"] for one in read.of("path") if one.get("stroke-width") == "2.2"]
    assert len(lines) == 2 and all(line.count("L") == 39 for line in lines)
    assert [one["type"] for one in read.of("input")].count("checkbox") == 2 + 3
    assert "model_free" in read.text and ODD in read.text and "Real episode 40" in read.text
    assert "Single runs, by number" in read.text and "runs go by number." in read.text
    assert "console" not in shown.stderr.lower()
