"""The settings of the CartPole experiment: its command line and its presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import optax

from jaxdyna.agents import CloningConfig, ReinforceConfig, ReinforceHParams
from jaxdyna.agents.reinforce import per_step
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.envs import CartPoleParams
from jaxdyna.experiments import cli
from jaxdyna.models import SupervisedConfig, SupervisedHParams
from jaxdyna.planners import SearchConfig, ShootingConfig
from jaxdyna.statistics import SolveRule

ArmName = Literal[
    "model_free",
    "dyna",
    "placebo",
    "oracle",
    "mpc",
    "mcts",
    "mpc_init",
    "mpc_init_dyna",
    "mpc_clone",
]
STEPS = {"v0": 200, "v1": 500}
RULES = {"v0": SolveRule(100, 195.0), "v1": SolveRule(100, 475.0)}


@dataclass(frozen=True)
class Options:
    """REINFORCE on CartPole, with and without fake episodes from a learned model."""

    preset: Literal["paper", "lean"] = "paper"
    """paper: the paper's protocol. lean: the fewest real episodes."""
    seeds: int = 10
    """Runs of every arm, all in one jitted program."""
    seed: int = 0
    """Base seed of all runs."""
    episodes: int = 1000
    """Real episodes of a run at the most."""
    arms: tuple[ArmName, ...] = ("model_free", "dyna")
    """model_free, dyna, and the controls: placebo never trains its model, oracle dreams in the true
    environment. And planners on the learned model: mpc (random shooting) and mcts (tree search, the
    planning extra) act instead of a policy; mpc_init imitates mpc and goes on model-free,
    mpc_init_dyna with dreams, mpc_clone not at all."""
    out: Path | None = None
    """Folder for the results; runs/cartpole-PRESET by default."""
    resume: bool = False
    """Go on with the run in that folder, bit for bit."""
    stop_after_solved: int | None = 100
    """Episodes an arm plays on once all its seeds have solved; None plays all of them."""
    env_version: Literal["v0", "v1"] = "v0"
    """v0: 200 steps, solved at 195. v1: 500 steps, solved at 475."""
    real_first: int = 100
    """N of the paper: real episodes before the first dream."""
    model_updates: int = 60
    """Gradient steps of the model after each real episode."""
    model_batch: int = 16
    """Transitions in each."""
    dream_updates: int = 2
    """Policy updates on dreams after each real episode."""
    dream_episodes: int = 8
    """Fake episodes in each."""
    dream_start: Literal["observed", "uniform", "branched"] = "observed"
    """Where dreams begin: first observations of real episodes, the authors' uniform ±0.1, or any
    observation of a real episode."""
    dream_steps: int | None = None
    """The longest fake episode; None for as long as a real one."""
    dream_noise: float = 0.0
    """Standard deviation of noise on every predicted state, in those of the model's targets."""
    rest_when_safe: bool = False
    """Learn only while something still falls: see `jaxdyna.settings.DynaConfig`."""
    authors_bug: bool = False
    """Overwrite the dreamed pole angle with the cart's velocity, as the authors' code does."""
    forget_every: int = 0
    """Empty the replay every so many real episodes, as the authors' code does; 0 never."""
    replay_capacity: int | None = None
    """Newest real transitions that the model may learn from; None for all."""
    terminal_share: float | None = None
    """Share of each model batch drawn from ends of episodes, however rare; None: as they come."""
    block: int | None = None
    """Runs vmapped together on a CPU, blocks one after the other; None for all at once."""
    mpc: ShootingConfig = field(default_factory=lambda: ShootingConfig(30, 32, temperature=5.0))
    """Random shooting: steps that are looked ahead, sequences that are tried."""
    mcts: SearchConfig = field(default_factory=lambda: SearchConfig(simulations=16))
    """Tree search: nodes, depth, discount, noise."""
    mcts_rollout: int = 20
    """Steps of the random episode in the model that says what a node is worth."""
    shown_episodes: int = 20
    """Real episodes after the first N in which the arms that imitate are shown what to do."""
    cloning: CloningConfig = field(default_factory=CloningConfig)
    """How they imitate."""
    agent: ReinforceConfig = field(default_factory=lambda: ReinforceConfig(advantage=per_step))
    """REINFORCE's network."""
    model: SupervisedConfig = field(
        default_factory=lambda: SupervisedConfig(
            delta=True, normalise=True, spread=3.0, weight_variance=1 / 3
        )
    )
    """The dynamics model."""
    hparams: DynaHParams = field(
        default_factory=lambda: DynaHParams(
            agent=ReinforceHParams(),
            model=SupervisedHParams(),
            env=CartPoleParams(),
            termination_threshold=0.1,
        )
    )
    """Learning rates, discount, physics: what `jaxdyna.sweep` can sweep."""

    def __post_init__(self) -> None:
        cli.check_common(self)
        if not self.arms:
            raise ValueError("--arms is empty: name at least one arm")
        if self.block is not None and self.block < 1:
            raise ValueError(f"--block is {self.block}: it must be at least 1, or None")
        if self.dream_steps is not None and self.dream_steps < 1:
            raise ValueError(f"--dream-steps is {self.dream_steps}: it must be at least 1, or None")
        for name in ("mcts_rollout", "shown_episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"--{name.replace('_', '-')} must be at least 1")
        if not 0 <= self.dream_noise < math.inf:
            raise ValueError(f"--dream-noise is {self.dream_noise}: it must be 0 or more")
        cli.check_numbers(self.hparams, "--hparams", may_be_infinite=["disagreement_threshold"])
        for flag, value, high in (
            ("termination-threshold", self.hparams.termination_threshold, 1.0),
            ("agent.discount", self.hparams.agent.discount, 1.0),
            ("agent.learning-rate", self.hparams.agent.learning_rate, math.inf),
            ("model.learning-rate", self.hparams.model.learning_rate, math.inf),
            ("real-weight", self.hparams.real_weight, math.inf),
            ("fake-weight", self.hparams.fake_weight, math.inf),
        ):
            if not 0 <= value <= high:
                raise ValueError(f"--hparams.{flag} is {value}: it must lie between 0 and {high:g}")
        for name in ("masscart", "masspole", "length", "tau"):
            if not getattr(self.hparams.env, name) > 0:
                raise ValueError(f"--hparams.env.{name} must be above 0")
        if self.hparams.env.max_steps not in (CartPoleParams().max_steps, self.num_steps):
            raise ValueError("--hparams.env.max-steps is decided by --env-version: leave it out")
        dyna_config(self)

    @property
    def num_steps(self) -> int:
        """The longest episode."""
        return STEPS[self.env_version]

    @property
    def rule(self) -> SolveRule:
        """When a run counts as solved."""
        return RULES[self.env_version]


def dyna_config(options: Options) -> DynaConfig:
    """The counts of a run."""
    return DynaConfig(
        num_episodes=options.episodes,
        num_real_first=options.real_first,
        num_steps=options.num_steps,
        model_updates=options.model_updates,
        model_batch=options.model_batch,
        dream_updates=options.dream_updates,
        dream_episodes=options.dream_episodes,
        forget_every=options.forget_every,
        replay_capacity=options.replay_capacity,
        rare_share=options.terminal_share,
        rest_when_safe=options.rest_when_safe,
    )


PAPER = Options()
LEAN = replace(
    PAPER,
    preset="lean",
    episodes=150,
    stop_after_solved=None,
    real_first=3,
    model_updates=100,
    model_batch=32,
    dream_updates=20,
    dream_episodes=16,
    rest_when_safe=True,
    terminal_share=0.25,
    block=1,
    model=SupervisedConfig(
        hidden=(64, 64),
        sum_loss=False,
        delta=True,
        normalise=True,
        one_hot=True,
        ensemble=3,
        optimizer=optax.adam,
    ),
    hparams=DynaHParams(
        agent=ReinforceHParams(learning_rate=0.02, discount=0.995),
        model=SupervisedHParams(learning_rate=3e-3),
        env=CartPoleParams(),
        real_weight=0.0,
        termination_threshold=0.1,
        disagreement_threshold=0.3,
    ),
)
PRESETS = {"paper": PAPER, "lean": LEAN}
