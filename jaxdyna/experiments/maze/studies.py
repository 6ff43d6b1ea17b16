"""Studies: the ``lean`` preset, one thing changed at a time: what it needs, what a worse model
costs, and whether sample efficiency grows with the model's accuracy (§5); from the paper's method
to what works, each step between the presets ``paper`` and ``tuned`` once added to the one and once
taken from the other; and the grids in which ``tuned`` and its baseline are tuned.
"""

from collections.abc import Collection
from dataclasses import replace
from functools import partial

from jaxdyna.experiments.engine import Overrides, Study
from jaxdyna.experiments.maze.acting import MAZE, final
from jaxdyna.experiments.maze.arms import arms
from jaxdyna.experiments.maze.options import TUNED, MazeOptions
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.rows import rows
from jaxdyna.experiments.report.summaries import first_dreams
from jaxdyna.experiments.study.accuracy import Measure, accuracy, describe
from jaxdyna.experiments.study.grids import both_grids
from jaxdyna.fields import value_at

OF = replace(MAZE, arms=partial(arms, judged=False), describe=())
OTHER = "agent: "
COLUMN = "first_solved"
MEASURE = Measure(
    curve="wrong_frames", episodes=35, hollow=OTHER,
    axis="share of frames predicted wrong (logarithmic)",
    said="The error is the share of frames that are predicted wrong anywhere, one step ahead. "
    "Every model is judged on the same new episodes: half of a uniformly random policy, half of "
    "one that drifts to the goal.",
    lines=("true environment as the model", "model-free", "model-free, as many updates"),
)  # fmt: skip
#: what changes the model alone
WORSE: dict[str, Overrides] = {
    "model: L2 loss": {"model_loss": "l2"},
    "model: L1 loss": {"model_loss": "l1"},
    "model: rare steps as they come": {"dyna.rare_share": None},
    "model: layers of (4, 4)": {"model_widths": (4, 4)},
    "model: layers of (32,)": {"model_widths": (32,)},
    "model: 100 updates an episode": {"dyna.model_updates": 100},
    "model: 10 updates an episode": {"dyna.model_updates": 10},
    "model: 3 updates an episode": {"dyna.model_updates": 3},
}
#: what changes how dreams are used and what the agent does with them, with the same model
LEARNING: dict[str, Overrides] = {
    "N = 2": {"dyna.num_real_first": 2},
    "N = 15": {"dyna.num_real_first": 15},
    "dreams of 1 step(s), as many steps": {"dyna.dream_steps": 1, "dyna.dream_episodes": 2000},
    "dreams of 20 step(s), as many steps": {"dyna.dream_steps": 20, "dyna.dream_episodes": 100},
    "a quarter of the dreams": {"dyna.dream_episodes": 100, "agent.fake_capacity": 2000},
    "four times the dreams": {"dyna.dream_episodes": 1600, "agent.fake_capacity": 32000},
    "25% of a batch dreamed": {"hparams.agent.fake_share": 0.25},
    "90% of a batch dreamed": {"hparams.agent.fake_share": 0.9},
    "200 updates on dreams to 100 on real steps": {"agent.fake_updates": 100},
    "1600 updates on dreams to 100 on real steps": {"agent.fake_updates": 800},
    "dreams broken off where half a pixel is in doubt": {
        "hparams.dream.uncertainty_threshold": 0.5
    },
    "dreams of the newest 16 real episodes, not 2": {"agent.fake_capacity": 64000},
}
CONTROLS: dict[str, Overrides] = {
    "untrained model (placebo)": {"arm": "placebo"},
    "true environment as the model": {"arm": "oracle"},
    "model-free": {"arm": "model_free"},
    "model-free, as many updates": {"arm": "more_updates"},
}


def levers(options: MazeOptions) -> dict[str, Overrides]:
    """Every row; those of `LEARNING`, and of what is kept of real episodes, are `OTHER` ones."""
    ten = 10 * options.steps
    other = LEARNING | {
        "the agent learns from the newest 10 real episodes only": {"agent.capacity": ten},
        "model and dreams know the newest 10 real episodes only": {"dyna.replay_capacity": ten},
    }
    renamed = {f"{OTHER}{name}": row for name, row in other.items()}
    return {"dyna (lean preset)": {}} | WORSE | renamed | CONTROLS


SHORT, MANY = "short dreams from any frames", "more dreams, fewer real updates"
#: what differs between the presets, by what it is for: each path belongs to one step
STEPS: dict[str, tuple[str, ...]] = {
    "a model of local convolutions": (
        "model", "coder_dense", "coder_decay", "dyna.model_updates",
        "hparams.model.learning_rate",
    ),
    "the reward read off the picture": ("model_reward", "reward_hidden", "reward_weights"),
    "rare steps drawn more often": ("dyna.rare_share",),
    SHORT: ("dream_start", "dyna.dream_steps"),
    MANY: (
        "dyna.dream_updates", "dyna.dream_episodes", "agent.updates", "agent.fake_updates",
        "agent.fake_capacity",
    ),
    "half of a batch dreamed": ("hparams.agent.fake_share",),
    "a normalised dueling network": ("network", "convolutions"),
    "faster learning": ("hparams.agent.learning_rate", "hparams.agent.target_rate"),
    "Double DQN under Huber's loss": ("agent.double", "agent.act_by_target", "agent.loss"),
    "draws by priority": ("hparams.agent.priority_exponent",),
    "directed exploration that ends": (
        "agent.drift", "agent.explore_until_rewarded", "hparams.agent.epsilon_first",
        "hparams.agent.epsilon_last", "hparams.agent.epsilon_hold",
        "hparams.agent.epsilon_episodes", "hparams.agent.epsilon_fake",
    ),
    "a discount of 0.95": ("hparams.agent.discount",)}  # fmt: skip
#: those that a model-free agent does not notice, but for the number of its updates
DREAMT = [*STEPS][:6]


def taken(options: MazeOptions, steps: Collection[str]) -> Overrides:
    """``paper``'s options with these steps as in ``tuned``. Dreams that are shorter are more, for
    as many dreamed steps, and longer ones fewer.
    """
    row = {path: value_at(TUNED, path) for step in steps for path in STEPS[step]}
    many = TUNED if MANY in steps else options
    long = row.get("dyna.dream_steps", options.dyna.dream_steps) or options.steps
    own = many.dyna.dream_steps or options.steps
    return row | {"dyna.dream_episodes": max(1, round(many.dyna.dream_episodes * own / long))}


def ladder(options: MazeOptions) -> dict[str, Overrides]:
    """Every row, the model-free ones after the others."""
    with_it = {f"paper with {step}": {step} for step in STEPS}
    without = {f"tuned without {step}": set(STEPS) - {step} for step in STEPS}
    table = {"paper": set(), **with_it, "tuned": set(STEPS), **without}
    made = {name: taken(options, steps) for name, steps in table.items()}
    unseen = {f"{side} {step}" for step in DREAMT if step != MANY
              for side in ("paper with", "tuned without")}  # fmt: skip
    alone = {f"model-free: {name}": {**row, "arm": "model_free"}
             for name, row in made.items() if name not in unseen}  # fmt: skip
    return made | alone


LEVERS = Study(
    name="levers",
    title="What does lean need in the Maze, and how good must its model be?",
    of=OF, preset="lean", rows=levers,
    common={
        "seeds": 4, "episodes": 100, "stop_after_solved": 0, "judged_on": "common",
        "size": 8, "obstacles": 3, "steps": 60,  # carries them all in two hours
        "dyna.eval_every": 0,
    },
    describe=(first_dreams, describe(MEASURE)),
    sections=(rows(COLUMN), accuracy(MEASURE, COLUMN), report.settings, report.spent))  # fmt: skip
LADDER = Study(
    name="ladder",
    title="From the paper's method to what works in the Maze, step by step",
    of=MAZE, preset="paper", rows=ladder,
    common={
        "episodes": 300, "stop_after_solved": 0,
        "size": 8, "obstacles": 3, "steps": 60, "coder_kernels": (3, 3, 3),  # that of `levers`
        "agent.updates": 60, "agent.fake_updates": 60,  # one a step
        "hparams.agent.epsilon_episodes": 200.0,
    },
    sections=(rows(), final, report.settings, report.spent))  # fmt: skip
BASELINES, DYNA_GRID = both_grids(
    "the Maze", OF, ratios=(0.25, 1, 2.25, 5), between=20_000, counts=(100, 200, 400, 800), kept=160
)
