"""From the paper's method to what works: each step between the presets ``paper`` and ``tuned``,
once added to the one and once taken from the other.
"""

from collections.abc import Collection

from jaxdyna.experiments.engine import Overrides, Study
from jaxdyna.experiments.maze.acting import MAZE, final
from jaxdyna.experiments.maze.options import TUNED, MazeOptions
from jaxdyna.experiments.report import sections as report
from jaxdyna.experiments.report.rows import rows
from jaxdyna.fields import value_at

SHORT, MANY = "short dreams from any frames", "more dreams, fewer real updates"
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
    "a discount of 0.95": ("hparams.agent.discount",),
}  # fmt: skip
"""What differs between the presets, by what it is for: each path belongs to one step."""
DREAMT = [*STEPS][:6]
"""Those that a model-free agent does not notice, but for the number of its updates."""


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
    every = {step: set(STEPS) - {step} for step in STEPS}
    with_it = {f"paper with {step}": {step} for step in STEPS}
    without = {f"tuned without {step}": rest for step, rest in every.items()}
    table = {"paper": set(), **with_it, "tuned": set(STEPS), **without}
    made = {name: taken(options, steps) for name, steps in table.items()}
    unseen = {f"{side} {step}" for step in DREAMT if step != MANY
              for side in ("paper with", "tuned without")}  # fmt: skip
    alone = {f"model-free: {name}": {**row, "arm": "model_free"}
             for name, row in made.items() if name not in unseen}  # fmt: skip
    return made | alone


LADDER = Study(
    name="ladder",
    title="From the paper's method to what works in the Maze, step by step",
    of=MAZE,
    preset="paper",
    rows=ladder,
    common={
        "episodes": 300, "stop_after_solved": 0,
        "size": 10, "obstacles": 3, "steps": 80, "coder_kernels": (3, 3, 3),  # as on a larger board
        "agent.updates": 80, "agent.fake_updates": 80,  # one a step
        "hparams.agent.epsilon_episodes": 200.0,
    },
    sections=(rows(), final, report.settings, report.spent),
)  # fmt: skip
