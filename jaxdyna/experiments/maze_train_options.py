"""The settings of learning to act in the Maze: its command line and its presets."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from jaxdyna.agents import CloningConfig, DQNConfig, DQNHParams
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.envs import Maze, MazeParams
from jaxdyna.envs.maze import MOVES
from jaxdyna.experiments import cli
from jaxdyna.experiments.maze_options import PAPER as FRAMES
from jaxdyna.experiments.maze_options import decayed_adam
from jaxdyna.losses import bce, l1, l2
from jaxdyna.models import PixelConfig, PixelHParams
from jaxdyna.networks import ConvolutionalQ, EncoderDecoder, GlimpseQ, LocalDynamics
from jaxdyna.planners import SearchConfig, ShootingConfig
from jaxdyna.statistics import SolveRule

ArmName = Literal[
    "model_free", "dyna", "placebo", "oracle", "more_updates", "mpc", "mcts", "mpc_init"
]
SHARE_OF_ORACLE = 0.95
WINDOW = 50
SHARES = (
    "discount", "epsilon_first", "epsilon_last", "epsilon_fake", "fake_share", "target_rate",
    "priority_exponent", "importance_exponent",
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """DQN in the Maze, with and without fake episodes from a learned model."""

    part: Literal["train", "model"] = "train"
    """train: learning to act; model: frame prediction alone (a command line of its own)."""
    preset: Literal["paper", "lean"] = "paper"
    """paper: the paper's N and a network of convolutions; lean: the fewest real episodes. The
    report says what is not the paper's."""
    quick: bool = False
    """A look at everything in minutes: two runs on a small board."""
    seeds: int = 10
    """Runs of every arm, all in one jitted program."""
    seed: int = 0
    """Base seed of all runs."""
    episodes: int = 500
    """Real episodes of a run at the most."""
    arms: tuple[ArmName, ...] = ("model_free", "dyna")
    """model_free, dyna, and the controls: placebo never trains its model; oracle dreams in
    the true environment, from the same frames; more_updates makes dyna's updates, all of them on
    real transitions. And planners on the learned frames: mpc (random shooting) and mcts (tree
    search, the planning extra) act; mpc_init imitates mpc and goes on model-free."""
    out: Path | None = None
    """Folder for the results; runs/maze-PRESET by default."""
    resume: bool = False
    """Go on with the run in that folder, bit for bit."""
    stop_after_solved: int | None = 0
    """Episodes an arm plays on once all its seeds have solved; None plays all of them."""
    size: int = 16
    """Cells a side of the board."""
    obstacles: int = 5
    """How many obstacles."""
    steps: int = 200
    """Steps of a real episode."""
    real_first: int = 100
    """N of the paper: real episodes before the first dream."""
    network: Literal["convolutions", "glimpse"] = "convolutions"
    """Network of the agent, the same in all arms. convolutions: three and a dense layer. glimpse:
    what is around the places of a few things, at first one of each colour."""
    convolutions: tuple[int, int, int] = (16, 16, 32)
    """Channels of the network's convolutions: one of 2x2 cells at a stride of 2, two of 3x3."""
    dense: int = 128
    """Width of the dense layer after the network's convolutions."""
    model_updates: int = 50
    """Gradient steps of the model after each real episode."""
    model_batch: int = 32
    """Transitions in each gradient step of the model."""
    model: Literal["local", "paper"] = "local"
    """Network of the model. local: 3x3 convolutions; paper: Fig. 4, slower and to be trained for
    much longer. Both read the reward off the picture that they predict."""
    model_widths: tuple[int, ...] = (32, 32)
    """Channels of the local model's convolutions."""
    model_loss: Literal["bce", "l2", "l1"] = "bce"
    """Loss of the model's pixels."""
    replay_capacity: int | None = None
    """Newest real transitions that the model learns from and dreams begin at; None: all."""
    rare_share: float | None = 0.25
    """At least this share of each model batch are collisions and goal steps; None: as they come."""
    dream_updates: int = 1
    """Times that dreams are played and learned from after each real episode."""
    dream_episodes: int = 400
    """Fake episodes each of these times."""
    dream_steps: int = 5
    """The longest fake episode; each begins at a real stack of frames."""
    mpc: ShootingConfig = field(default_factory=lambda: ShootingConfig(5, 32, drift=1.0))
    """Random shooting: steps that are looked ahead, sequences that are tried. Its discount is the
    agent's, whose values say what comes after."""
    mcts: SearchConfig = field(default_factory=lambda: SearchConfig(simulations=32))
    """Tree search: nodes, depth, noise. Its discount is the agent's."""
    shown_episodes: int = 10
    """Real episodes after the first N in which mpc_init is shown what to do."""
    cloning: CloningConfig = field(default_factory=lambda: CloningConfig(learning_rate=1e-3))
    """How mpc_init imitates."""
    agent: DQNConfig = field(
        default_factory=lambda: DQNConfig(
            updates=50, fake_updates=400, fake_capacity=64_000, explore_until_rewarded=True
        )
    )
    """Updates, batches and replays of the agent (DQN)."""
    hparams: DynaHParams = field(
        default_factory=lambda: DynaHParams(
            agent=DQNHParams(epsilon_hold=30.0, target_rate=0.02),
            model=PixelHParams(3e-3),
            env=MazeParams(),
        )
    )
    """Learning rates, discount, rewards: what `jaxdyna.sweep` can sweep."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if not self.arms:
            raise ValueError("--arms is empty: name at least one arm")
        if self.hparams.env.max_steps not in (MazeParams().max_steps, self.steps):
            raise ValueError("--hparams.env.max-steps is decided by --steps: leave it out")
        cli.check_numbers(self.hparams, "--hparams", may_be_infinite=["disagreement_threshold"])
        for name in SHARES:
            if not 0 <= getattr(self.hparams.agent, name) <= 1:
                flag = f"--hparams.agent.{name.replace('_', '-')}"
                raise ValueError(f"{flag} must lie between 0 and 1")
        if self.steps < 2 * self.size - 1:
            raise ValueError(
                f"--steps is {self.steps}: the goal is {2 * self.size - 2} steps away, give it more"
            )
        if self.model == "paper" and self.size < sum(FRAMES.kernels) - 2:
            raise ValueError("--model paper needs a larger --size, or choose --model local")
        if self.dream_steps > self.steps:
            raise ValueError("--dream-steps is more than --steps: a dream is no longer than that")
        for name in ("model_widths", "convolutions"):
            if min(getattr(self, name), default=0) < 1:
                raise ValueError(f"--{name.replace('_', '-')}: give numbers of at least 1")
        if self.shown_episodes < 1:
            raise ValueError("--shown-episodes must be at least 1")
        if self.dense < 1:
            raise ValueError("--dense must be at least 1")
        Maze(self.size, self.obstacles)
        dyna_config(self)

    @property
    def rule(self) -> SolveRule:
        """When a run counts as solved (the Contract's rule)."""
        return SolveRule(WINDOW, SHARE_OF_ORACLE, "oracle_return")


def dyna_config(options: Options) -> DynaConfig:
    """The counts of a run."""
    return DynaConfig(
        num_episodes=options.episodes,
        num_real_first=options.real_first,
        num_steps=options.steps,
        model_updates=options.model_updates,
        model_batch=options.model_batch,
        dream_updates=options.dream_updates,
        dream_episodes=options.dream_episodes,
        dream_steps=options.dream_steps,
        rare_share=options.rare_share,
        replay_capacity=options.replay_capacity,
    )


def agent_config(options: Options) -> DQNConfig:
    """DQN's counts, with room for what this run can add to its replays and no more."""
    real = options.episodes * options.steps
    dreams = options.dream_updates * options.dream_episodes
    agent = options.agent
    fake_capacity = max(agent.fake_capacity, dreams * options.dream_steps)
    networks = {
        "convolutions": ConvolutionalQ(len(MOVES), options.convolutions, options.dense),
        "glimpse": GlimpseQ(len(MOVES)),
    }
    return replace(
        agent,
        network=networks[options.network],
        capacity=max(min(agent.capacity, real), options.steps),
        episodes=min(agent.episodes, options.episodes),
        fake_capacity=fake_capacity,
        fake_episodes=max(agent.fake_episodes, fake_capacity // options.dream_steps, dreams),
    )


def model_config(options: Options) -> PixelConfig:
    """The model's network, loss and optimiser."""
    loss = {"bce": bce, "l1": l1, "l2": l2}[options.model_loss]
    if options.model == "local":
        return PixelConfig(LocalDynamics(3, tuple(options.model_widths)), loss)
    coder = EncoderDecoder(3, dense=FRAMES.dense)
    threshold = 0.2 if loss is bce else 0.5
    optimizer = decayed_adam(FRAMES.paper.weight_decay)
    return PixelConfig(coder, loss, threshold, optimizer=optimizer)


PAPER = Options()
LEAN = replace(
    PAPER,
    preset="lean",
    network="glimpse",
    episodes=150,
    stop_after_solved=50,
    real_first=15,
    model_updates=100,
    agent=replace(PAPER.agent, updates=100),
    hparams=DynaHParams(
        agent=DQNHParams(epsilon_hold=15.0, epsilon_episodes=5.0),
        model=PixelHParams(3e-3),
        env=MazeParams(),
    ),
)
PRESETS = {"paper": PAPER, "lean": LEAN}
_FEW: dict[str, Any] = {"quick": True, "seeds": 2, "size": 6, "obstacles": 1, "steps": 40}
_FEW |= {"episodes": 80}
_SOON = replace(PAPER.hparams.agent, epsilon_hold=5.0, epsilon_episodes=10.0)
QUICK = {
    "paper": replace(PAPER, **_FEW, real_first=15, hparams=replace(PAPER.hparams, agent=_SOON)),
    "lean": replace(LEAN, **_FEW),
}
