"""Learning to act in the Maze (§4.2, Fig. 8, Table 2): the experiment and its report."""

from typing import Any

import numpy as np

from jaxdyna.experiments.engine import Experiment
from jaxdyna.experiments.maze.arms import SAID, STARTS, arms
from jaxdyna.experiments.maze.options import LEAN, PAPER, QUICK, RULE, TUNED, MazeOptions, rule
from jaxdyna.experiments.report import frozen, sections as report
from jaxdyna.experiments.report.tables import markdown_table, median, with_interval
from jaxdyna.statistics import last_mean, mean_of_runs, running_mean, summarise

EPISODES = {"model_free": 700.0, "dyna": 250.0}
RATIO = {"dyna": 0.36}
BEHAVIOUR = {
    "collisions": "collisions an episode", "time_to_goal": "steps until the goal",
    "waits": "steps spent waiting for an obstacle"}  # fmt: skip
RARE, REACHED, WAITED = 0.5, 0.9, 0.25
WAITING = 50  #: episodes over which it is counted how often the agent waits: it seldom has to
LEARNED = {"collisions": "collisions are rare", "goal": "the goal is reached", "waits": "it waits"}
TRAINED = ("dyna", "mpc", "mcts", "mpc_init")  #: arms with a model that learns
SMOOTHED = 10
DIFFERENT = (
    "Not the paper's, or not said there: Double DQN; dueling values and Huber's loss; draws by "
    "priority; acting by the averaged network; normalised dense layers, and in `lean` glimpses "
    "instead of convolutions; a discount below 1 (the authors' code has 1); directed exploration, "
    "until a reward and none in the end; the number of updates (the authors' code makes one a "
    "real step) and, in `lean`, N (the paper's is 100); several short dreams after each real "
    "episode, which begin at replayed frames; a model of local convolutions instead of Fig. 4, its "
    "pixels lit from 0.5 on (the paper's from 0.2), which reads rewards off the predicted picture "
    "as a sum over its cells and sees rare steps more often."
)
LITERAL = (
    "Not the paper's, nor its authors': a discount below 1; widths a quarter of the authors'; one "
    "layer for the action's factor, which starts around 1; the reward's loss beside the sum of the "
    "pixels' losses; a step's update after its episode; fake episodes that begin with the first "
    "frame of a real one; all data is kept. Line by line: docs/paper-method.md."
)


def describe(options: MazeOptions, curves: Any) -> dict[str, Any]:
    """The final greedy policy in numbers, and how wrong the model is."""
    share = curves["greedy_return"].mean(1) / curves["greedy_optimal"].mean(1)
    hits = curves["greedy_collisions"].mean(1)
    spans = {"first_dreams": max(options.dyna.num_real_first, 1) - 1 + SMOOTHED, "last": None}
    model = {
        wrong: {when: float(last_mean(curves[wrong][:, :end], SMOOTHED).mean())
                for when, end in spans.items()}
        for wrong in report.WRONG if wrong in curves}  # fmt: skip
    greedy = {"share": mean_of_runs(share), "collisions": mean_of_runs(hits)}
    learned = {
        name: summarise(at, at_least=options.episodes)
        for name, at in learned_at(curves, options.steps).items()
    }
    return {"greedy": greedy, "model": model, "learned": learned}


def learned_at(curves: Any, steps: int) -> dict[str, np.ndarray]:
    """The first real episode, from 1, ``[runs]``, infinity where there is none, at which

    - ``collisions`` are rare: `RARE` an episode or fewer, over the last `SMOOTHED`;
    - the ``goal`` is reached, within the episode's ``steps``, in `REACHED` of the last `SMOOTHED`;
    - it ``waits``: over the last `WAITING` it holds back in a share of the steps in which it would
      have collided ahead that is higher, by `WAITED`, than of those in which it would not.
    """

    def first(reached: np.ndarray, window: int) -> np.ndarray:
        reached = reached & (np.arange(reached.shape[1]) >= window - 1)
        return np.where(reached.any(1), reached.argmax(1) + 1.0, np.inf)

    to_goal = curves["time_to_goal"]
    arrived = np.where(np.isfinite(to_goal), to_goal <= steps, np.nan)
    means = running_mean(curves["collisions"], SMOOTHED), running_mean(arrived, SMOOTHED)
    found = {
        "collisions": first(means[0] <= RARE + 1e-9, SMOOTHED),
        "goal": first(means[1] >= REACHED - 1e-9, SMOOTHED),
    }
    if "waits" in curves:
        names = ("waits", "threats", "dawdles")
        waits, threats, dawdles = (running_mean(curves[name], WAITING) for name in names)
        free = running_mean(np.minimum(to_goal, steps), WAITING) - threats
        with np.errstate(divide="ignore", invalid="ignore"):
            found["waits"] = first(waits / threats - dawdles / free >= WAITED, WAITING)
    return found


def model_errors(record: Any) -> str:
    """How wrong the learned models are on real episodes that are new to them."""
    header = ["model of", "frames wrong: first ten episodes with dreams", "last ten episodes",
              "rewards wrong: first ten", "last ten"]  # fmt: skip
    rows = [
        [name, *(f"{share:.2%}" for wrong in arm["model"].values() for share in wrong.values())]
        for name, arm in record.results["arms"].items()
        if arm["model"]
    ]
    return markdown_table(header, rows) if rows else ""


def order(record: Any) -> str:
    """What is learned first (§4.2): the episode at which each thing is, in the median run."""
    rows = [
        [name, *(median(arm["learned"][one]) if one in arm["learned"] else "-" for one in LEARNED)]
        for name, arm in record.results["arms"].items()
    ]
    return report.paragraphs(
        "The real episode, in the median run (95% interval), from which on collisions have been "
        f"rare ({RARE:g} an episode or fewer over {SMOOTHED} episodes), the goal has been reached "
        f"(in {REACHED:g} of {SMOOTHED} episodes), and the agent waits for obstacles: of the steps "
        "on its way in which a move that comes closer to the goal would have ended on an obstacle, "
        f"it does not come closer in a share that is {WAITED:g} higher than of all other steps, "
        f"over {WAITING} episodes (a random walk: in equal shares). The paper's order is "
        "collisions first, then the goal, then waiting.",
        markdown_table(["arm", *LEARNED.values()], rows),
    )


def final(record: Any) -> str:
    """How good the final policies are."""
    rows = [
        [name, *(with_interval(arm["greedy"][of], 3) for of in ("share", "collisions"))]
        for name, arm in record.results["arms"].items()
    ]
    return report.paragraphs(
        "## The final policy",
        f"Greedy, each run's on {STARTS:,} new starts, as it is after the run's last episode: "
        "share of the optimum, and collisions an episode; 95% intervals over runs.",
        markdown_table(["arm", "share of the optimum", "collisions"], rows),
    )


MAZE = Experiment(
    name="maze",
    title="The Maze: learning to act",
    presets={"tuned": TUNED, "lean": LEAN, "paper": PAPER},
    quick=QUICK, arms=arms, rule=rule,
    describe=(describe, frozen.describe(rule)),
    sections=(
        report.solving(rule, EPISODES, RATIO, "The optimal return is the most that could be had "
                       "from an episode's own start (value iteration)."),
        report.learning_curves(rule, "fig8.png", "Fig. 8: share of the optimum against real "
                               "episodes", "share of the optimum", SMOOTHED),
        lambda record: f"The figure's running mean is shorter than the rule's {RULE.window} "
        "episodes: a curve may be above the line before a run has solved.",
        report.area, report.thresholds(rule), frozen.frozen(rule), report.endings(rule),
        lambda record: "## What is learned, when",
        report.behaviour(
            BEHAVIOUR, SMOOTHED,
            said="An episode that never comes to the goal counts as one step more than it has.",
        ),
        order,
        report.behaviour(
            report.WRONG, SMOOTHED, "model.png", "A frame is predicted wrong where any pixel is, "
            "one step ahead, and a reward by half a point; each real episode is judged before the "
            "model learns from it. An untrained model, which is always wrong, is not drawn.",
            TRAINED,
        ),
        model_errors, final, report.arms_said(SAID), report.settings,
        lambda record: LITERAL if record.options.preset == "paper" else DIFFERENT, report.spent,
    ),
)  # fmt: skip
