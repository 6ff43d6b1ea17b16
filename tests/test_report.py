"""What reports say beside their tables."""

import io
import re
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from jaxdyna.experiments.cartpole.options import TUNED
from jaxdyna.experiments.engine import cli
from jaxdyna.experiments.engine.experiment import Experiment
from jaxdyna.experiments.engine.record import write_report
from jaxdyna.experiments.report import frozen, plots, sections as report
from jaxdyna.experiments.report.summaries import break_even, describe_arm, restricted
from jaxdyna.fields import changed
from jaxdyna.statistics import SolveRule, summarise

RULE = SolveRule(2, 1.0)
RATE = "hparams.agent.learning_rate"


def record(out, runs, stop=None, name="dyna", **more):
    """Runs by their returns, each solved or over at its own end."""
    length = max(map(len, runs))
    returns = np.array([[*run, *[np.nan] * (length - len(run))] for run in runs], float)
    curves = {"real_return": returns, "real_length": np.ones_like(returns)}
    options = SimpleNamespace(stop_after_solved=stop, episodes=9, dyna=SimpleNamespace(
        num_real_first=2))  # fmt: skip
    results = {
        "runs": {"seeds": list(range(len(runs)))}, "sweep": {}, "config": {"episodes": 9},
        "arms": {name: describe_arm(curves, RULE, 9)}, "command": f"it --arms {name}",
    }  # fmt: skip
    return SimpleNamespace(options=options, results=results | more, curves={name: curves}, out=out)


def rule(options):
    return RULE


@pytest.mark.parametrize(("runs", "said"), [(5, True), (6, False)])
def test_why_there_is_no_interval(runs, said, tmp_path):
    text = report.solving(rule)(record(tmp_path, [[0, 1, 1 + run] for run in range(runs)]))
    assert ("Figures of solving have no interval" in text) == said


def test_a_threshold_that_no_episode_reached_is_told(tmp_path):
    never = report.solving(rule)(record(tmp_path, [[0, 0.25, 0.5]] * 2))
    assert "**No episode of any run reached the threshold**; the highest return was 0.5" in never
    assert "No episode" not in report.solving(rule)(record(tmp_path, [[0, 0, 1]] * 2))


def test_runs_too_short_to_solve_are_not_compared(tmp_path):
    """A window of more episodes than runs have; without a rule there is nothing to say."""
    made = record(tmp_path, [[0, 1, 1]] * 2)
    sections = report.solving, report.thresholds, report.solved_share, report.endings
    short = [section(lambda options: SolveRule(10, 1.0))(made) for section in sections]
    assert short[0].startswith(
        "**No run can have solved**: the rule asks for 10 episodes, and runs"
    )
    assert short[1:] == ["", "", ""]
    assert [section(lambda options: None)(made) for section in sections] == [""] * 4


def test_on_a_console_names_of_what_was_swept_are_broken_not_cut():
    table = f"| arm |\n| --- |\n| dyna@{RATE}=0.0123 |\n\n![figure](a.png)\n"
    console = Console(width=44, file=io.StringIO())
    console.print(cli.spoken(table))
    said = console.file.getvalue()
    assert f"{RATE}=0.0123" in said and "figure" not in said and "…" not in said


def test_what_held_is_told_where_runs_play_on(tmp_path):
    runs = [[0, 1, 1], [1, 1]]
    assert "| 2/2 |" not in report.endings(rule)(record(tmp_path, runs, stop=0))
    assert "(-: runs end 0 episodes after they have solved)" in report.endings(rule)(
        record(tmp_path, runs, stop=0)
    )
    held = [[1] * 60, [1] * 60]
    assert "| 2/2 |" in report.endings(rule)(record(tmp_path, held))


def test_what_was_swept_is_called_by_its_last_word_except_in_commands_and_files(tmp_path):
    name = f"dyna@{RATE}=0.1"
    said = Experiment("it", "It", {}, lambda options: {}, sections=(
        lambda record: f"{name} needs less", lambda record: f"![of {name}](fig_{name}.png)",
    ))  # fmt: skip
    lines = write_report(said, record(tmp_path, [[1, 1]], name=name)).splitlines()
    assert lines[2:] == ["`it --arms dyna@hparams.agent.learning_rate=0.1`", "",
                         "dyna@learning_rate=0.1 needs less", "",
                         f"![of dyna@learning_rate=0.1](fig_{name}.png)"]  # fmt: skip


def test_the_share_that_has_solved_counts_as_the_table_does(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(plots, "bands", lambda path, panels, *_, **__: drawn.update(panels[""]))
    one = record(tmp_path, [[0, 1, 1, 1], [1, 1]])
    report.solved_share(rule)(one)
    assert drawn["dyna"].mean(0).tolist() == [0, 0.5, 1, 1]
    assert one.results["arms"]["dyna"]["episodes_to_solve"]["per_seed"] == [3, 2]


def test_a_legend_of_long_names_has_fewer_columns(tmp_path):
    def columns(names):
        figure, panel = plots.subplots(figsize=(5.6, 4.0))
        for name in names:
            panel.plot([0, 1], label=name)
        plots.legend_above(figure, [panel])
        return figure.legends[0]._ncols

    assert columns("abcd") == 4 and columns([f"dyna@{RATE}={n}" for n in range(3)]) == 1


def test_a_figure_of_fewer_arms_than_there_are_says_so(tmp_path, monkeypatch):
    made = record(tmp_path, [[0, 1, 1]] * 2)
    for number in range(7):
        made.curves[f"dyna@{number}"] = made.curves["dyna"]
    section = report.learning_curves(rule)
    shares = []
    monkeypatch.setattr(plots, "shares", lambda file, solved, *_: shares.append([*solved]))
    assert "Curves are drawn" not in section(made)
    made.curves["model_free"] = made.curves["dyna"]
    assert "Curves are drawn of 8 of the 9 arms." in section(made)
    assert len(shares[1]) == 8


def test_when_dreams_begin_is_drawn_where_it_is_one_episode(tmp_path, monkeypatch):
    marks = []
    monkeypatch.setattr(plots, "learning_curves", lambda *arguments: marks.append(arguments[4]))
    made = record(tmp_path, [[0, 1, 1]] * 2)
    report.learning_curves(rule)(made)
    made.results["sweep"] = {"dyna.num_real_first": [2, 3]}
    report.learning_curves(rule)(made)
    assert marks == [{"dreams begin": 2}, {}]


def test_lower_thresholds_are_reached_earlier(tmp_path, monkeypatch):
    """By hand: dyna is at 5 from the third episode on and at 10 from the fifth, model_free at 5
    from the sixth on and never at 10.
    """
    drawn = {}
    played = {"dyna": [0, 0, 5, 5, 10, 10, 10, 10], "model_free": [0] * 5 + [5] * 3}
    monkeypatch.setattr(
        plots, "bands", lambda path, panels, *rest, **more: drawn.update(panels[""]) or True
    )
    asked = SimpleNamespace(
        options=SimpleNamespace(episodes=8), out=tmp_path,
        curves={name: {"real_return": np.tile(np.array(values, float), (2, 1))}
                for name, values in played.items()},
    )  # fmt: skip
    text = report.thresholds(lambda options: SolveRule(1, 10.0))(asked)
    assert drawn["dyna"].tolist() == 2 * [[3] + 10 * [5]]
    assert drawn["model_free"].tolist() == 2 * [[6] + 10 * [8]]
    assert "0.50: 0.50; 0.60: 0.62; 0.70: 0.62" in text and "(thresholds.png)" in text
    assert report.thresholds(lambda options: SolveRule(1, 0.0))(asked) == ""


def judged(out):
    """Two runs whose policies are evaluated after every second episode, one over after four."""
    nan = np.nan
    curves = {
        "real_return": np.ones((2, 6)),
        "real_length": np.array([[30.0, 30, 30, 30, nan, nan], [10, 40, 50, 100, 10, 190]]),
        "frozen_return": np.array([[nan, 0.5, nan, 2, nan, nan], [nan, 1, nan, 0.9, nan, 1]]),
    }
    found = frozen.describe(rule)(None, curves)
    options = SimpleNamespace(dyna=SimpleNamespace(eval_every=2, eval_episodes=7))
    results = {"arms": {"dyna": found, "model_free": {}}}
    return SimpleNamespace(options=options, results=results, curves={"dyna": curves}, out=out)


def test_what_frozen_policies_are_worth_by_hand(tmp_path):
    made = judged(tmp_path)
    curves, found = made.curves["dyna"], made.results["arms"]["dyna"]
    at = np.array([49, 50, 60, 200, 10_000])
    expected = [[-np.inf, -np.inf, 0.5, 2, 2], [-np.inf, 1, 1, 0.9, 1]]
    np.testing.assert_array_equal(frozen.worth(curves, at), expected)
    entry = found["frozen"]
    assert entry["real_steps_to_solve"]["per_seed"] == [120, 50]
    assert list(entry["snapshots"]) == ["50", "100", "200", "400"]
    assert [one["solved"] for one in entry["snapshots"].values()] == [1, 1, 1, 2]
    assert entry["snapshots"]["100"]["mean"] == 0.75
    assert entry["snapshots"]["50"]["per_seed"] == [None, 1.0]


def test_frozen_policies_ask_for_a_share_of_what_could_be_had():
    curves = {"frozen_return": np.array([[4.0]]), "real_length": np.array([[9.0]]),
              "best": np.array([[6.0, np.nan, 4.0]])}  # fmt: skip
    share = SolveRule(2, 0.8, share_of="best")
    assert frozen.threshold(curves, share) == 4
    solved = frozen.describe(lambda options: share)(None, curves)["frozen"]["real_steps_to_solve"]
    assert solved["per_seed"] == [9]


def test_the_report_of_frozen_policies(tmp_path):
    text = frozen.frozen(rule)(judged(tmp_path))
    assert "After every 2 real episodes" in text
    assert "plays 7 new episodes" in text
    assert "| dyna | 2/2 | 85 | 120 |" in text
    assert (tmp_path / "frozen.png").exists()
    without = judged(tmp_path)
    without.results["arms"]["dyna"] = frozen.describe(rule)(None, {"real_length": np.ones((2, 3))})
    assert frozen.frozen(rule)(without) == ""


def test_the_area_under_the_learning_curve_ends_with_the_first_run(tmp_path):
    one = record(tmp_path, [[0, 1, 2, 3]] * 2 + [[2, 3]])
    assert report.area(one) == ""
    one.curves["model_free"] = {"real_return": np.array([[0, 0.5, 7]] * 3)}
    said = report.area(one)
    assert "of the first 2 real episodes" in said
    assert "dyna 1.2; model_free 0.2" in said
    runs = np.arange(6.0)[:, None] * np.ones((6, 3))
    more = {"model_free": 0, "more_updates": 1, "dyna": 6, "model_free@x=1": 6, "dyna@x=1": 12}
    one.curves = {name: {"real_return": runs + more} for name, more in more.items()}
    one.results["arms"] |= {name: {"arm": name.partition("@")[0], "setting": "x=1"}
                            for name in more if "@" in name}  # fmt: skip
    said = report.area(one)  # 0.002 is the least p that ranks of six and six can have
    told = [
        re.sub(r" [\d.]+ \([^)]*\)", "", part) for part in said.partition("played: ")[2].split("; ")
    ]
    assert told[0] == "model_free" and told[3] == "model_free@x=1"
    assert told[2].startswith("dyna, p = 0.002 against model_free, p = 0.0")
    assert told[2].endswith(" against more_updates")
    assert told[4] == "dyna@x=1, p = 0.002 against model_free@x=1 (Brunner and Munzel's test)."


def test_what_a_real_step_has_to_cost_by_hand(tmp_path):
    """Six runs in three blocks on two cores: 30 s are 10 core-seconds a run, 6 s are 2. Dreams save
    1 real step of 5 on average: 8 s for it.
    """
    arms = {
        name: {"real_steps_to_solve": {
            "per_seed": steps, "restricted_mean": mean, "solved": 3, "seeds": 6}}
        for name, steps, mean in (("dyna", [3.9, 4.1] * 3, 4), ("model_free", [4.9, None] * 3, 5))
    }  # fmt: skip
    results = {
        "runs": {"seeds": list(range(6)), "block": 2}, "arms": arms,
        "device": {"platform": "cpu", "cpu_cores": 2, "count": 1},
        "timing": {"arms": {"dyna": {"run_s": 30.0}, "model_free": {"run_s": 6.0}}},
    }  # fmt: skip
    assert break_even(results) == pytest.approx((8, 1, 8000))
    on_one = results | {"device": results["device"] | {"platform": "gpu"}}
    assert break_even(on_one) == pytest.approx((4, 1, 4000))
    swapped = dict(zip(arms, reversed(arms.values()), strict=True))
    assert break_even(results | {"arms": swapped}) is None  # they save nothing
    steps = {"dyna": [1.0, 9, 2, 8, 3, 7, 4], "model_free": [2.0, 9, 1, 9, 4, 7, 4]}
    noisy = {name: {"real_steps_to_solve": summarise(np.array(own), at_least=9)}
             for name, own in steps.items()}  # fmt: skip
    assert break_even(results | {"arms": noisy}) is None  # nor what is not told apart from nothing
    hardly = {name: {"real_steps_to_solve": {**arm["real_steps_to_solve"], "solved": 2}}
              for name, arm in arms.items()}  # fmt: skip
    assert break_even(results | {"arms": hardly}) is None
    assert break_even(results | {"timing": {"arms": {"dyna": {"run_s": 1.0}}}}) is None
    unsolved = results["arms"]["dyna"]["real_steps_to_solve"] | {"solved": 0}
    dyna = results["arms"]["dyna"] | {"real_steps_to_solve": unsolved}
    assert break_even(results | {"arms": results["arms"] | {"dyna": dyna}}) is None
    assert "longer than **8,000 ms**: a run of dyna computes for 8 s more" in report._price(results)
    results["timing"]["arms"]["model_free"]["run_s"] = 60.0
    assert "**whatever a real step takes**: a run of dyna computes for 10 s less" in (
        report._price(results)
    )


def test_unsolved_runs_count_each_with_its_own():
    figure = summarise(np.array([3.0, np.inf, 5, np.inf]), at_least=np.array([9.0, 7, 9, 11]))
    np.testing.assert_array_equal(restricted(figure), [3, 7, 5, 11])
    earlier = {name: value for name, value in figure.items() if name != "restricted_per_seed"}
    np.testing.assert_array_equal(restricted(earlier), [3, 9, 5, 9])


@pytest.mark.parametrize("part", ["cartpole", "baselines"])
def test_settings_of_arms_that_were_not_played_are_left_out(part, tmp_path):
    made = record(tmp_path, [[0, 1]] * 2, experiment="cartpole", part=part)
    options = changed(TUNED, {"cloning.learning_rate": 0.0625})
    text = report.settings(SimpleNamespace(options=options, results=made.results))
    for name in ("dqn_hparams.learning_rate", "cloning.learning_rate"):
        assert (f"`{name}`" in text) == (part == "baselines")
    assert "`hparams.agent.learning_rate`" in text
