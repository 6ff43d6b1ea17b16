"""The settings of CartPole and its presets."""

from dataclasses import dataclass
from typing import ClassVar, Literal, Self

import optax

from jaxdyna.agents import CloningConfig, DQNConfig, DQNHParams, ReinforceConfig, ReinforceHParams
from jaxdyna.agents.reinforce import per_step, within_episode
from jaxdyna.dyna import DynaConfig, DynaHParams
from jaxdyna.envs import CartPoleParams
from jaxdyna.experiments.engine import Options
from jaxdyna.fields import LARGEST, changed, setting
from jaxdyna.models import DreamHParams, SupervisedConfig, SupervisedHParams
from jaxdyna.planners import SearchConfig, ShootingConfig
from jaxdyna.statistics import SolveRule

STEPS = {"v0": 200, "v1": 500}
EVERY_ACTION = "MuZero's search, which looks at every action"
NO_DREAMS = "the arm dqn, which never dreams"
RULES = {"v0": SolveRule(100, 195.0), "v1": SolveRule(100, 475.0)}


@dataclass(frozen=True, kw_only=True)
class CartPoleOptions(Options):
    """REINFORCE on CartPole, with and without fake episodes from a learned model."""

    decided: ClassVar = {
        "dyna.num_episodes": "--episodes", "dyna.num_steps": "--env-version",
        "hparams.env.max_steps": "--env-version",
        "mcts.considered": EVERY_ACTION, "mcts.gumbel_scale": EVERY_ACTION,
        "dqn.network": "--dqn-hidden",
        **{f"dqn.fake_{name}": NO_DREAMS for name in ("updates", "capacity", "episodes")},
        **{f"dqn_hparams.{name}": NO_DREAMS for name in ("epsilon_fake", "fake_share")},
    }  # fmt: skip

    env_version: Literal["v0", "v1"] = setting(
        "v0", "v0: 200 steps, solved at 195; v1: 500 steps, solved at 475", everyday=True
    )
    dream_start: Literal["observed", "uniform", "branched"] = setting(
        "observed", "where dreams begin: first observations of real episodes, the authors' uniform "
        "±0.1, or any observation of a real episode", everyday=True)  # fmt: skip
    dream_noise: float = setting(
        0.0, "standard deviation of noise on every predicted state, in those of the targets",
        at_least=0)  # fmt: skip
    authors_bug: bool = setting(
        False, "whether the dreamed pole angle is overwritten with the cart's velocity, as the "
        "authors' code does")  # fmt: skip
    judged_on: Literal["own", "common"] = setting(
        "own", "what a model is judged on: each real episode before it is trained on it, or the "
        "same transitions for all models")  # fmt: skip
    rest_when_safe: bool = setting(
        False, "whether dreaming stops once no fake episode of two updates in a row fell; then "
        "model and policy learn of no dreams until a real episode falls: what works is left alone",
    )  # fmt: skip
    forget_every: int = setting(
        0, "real episodes after which the replay is emptied, as the authors' code does; 0 never",
        at_least=0)  # fmt: skip
    mcts_rollout: int = setting(
        20, "steps of the random episode in the model that says what a node is worth", at_least=1
    )
    shown_episodes: int = setting(
        20, "real episodes after the first N in which arms that imitate are shown what to do",
        at_least=1)  # fmt: skip
    dyna: DynaConfig = setting(factory=lambda: DynaConfig(
        num_episodes=LARGEST, num_steps=1,  # until they are decided, in nobody's way
        num_real_first=100, model_updates=60, model_batch=16, dream_updates=2, dream_episodes=8,
        eval_every=10))  # fmt: skip
    agent: ReinforceConfig = setting(factory=lambda: ReinforceConfig(advantage=per_step))
    model: SupervisedConfig = setting(factory=lambda: SupervisedConfig(
        delta=True, normalise=True, spread=3.0, weight_variance=1 / 3))  # fmt: skip
    mpc: ShootingConfig = setting(factory=lambda: ShootingConfig(30, 32, temperature=5.0))
    mcts: SearchConfig = setting(factory=lambda: SearchConfig(simulations=16))
    cloning: CloningConfig = setting(factory=CloningConfig)
    hparams: DynaHParams = setting(factory=lambda: DynaHParams(
        ReinforceHParams(), SupervisedHParams(), CartPoleParams(), DreamHParams(0.1)))  # fmt: skip
    dqn_hidden: tuple[int, ...] = setting(
        (64, 64), "widths of the hidden layers of the arm dqn", at_least=1
    )
    dqn: DQNConfig = setting(factory=lambda: DQNConfig(
        updates=0, updates_per_step=1.0, batch=64, drift=0.0, capacity=50_000, fake_capacity=1,
        fake_episodes=1))  # fmt: skip
    dqn_hparams: DQNHParams = setting(factory=lambda: DQNHParams(
        discount=0.99, epsilon_episodes=50.0))  # fmt: skip

    def resolved(self) -> Self:
        """An episode is as long as ``--env-version`` says."""
        steps = STEPS[self.env_version]
        return changed(self, {
            "dyna.num_episodes": self.episodes, "dyna.num_steps": steps,
            "hparams.env.max_steps": steps})  # fmt: skip


def rule(options: CartPoleOptions) -> SolveRule:
    """When a run counts as solved."""
    return RULES[options.env_version]


TUNED = CartPoleOptions(arms=("model_free", "dyna"), stop_after_solved=100, block=2)
LEAN = changed(TUNED, {
    "preset": "lean", "episodes": 150, "stop_after_solved": None, "block": 1,
    "dyna.num_real_first": 3, "dyna.model_updates": 1000, "dyna.model_batch": 32,
    "dyna.dream_updates": 200, "dyna.dream_episodes": 16, "rest_when_safe": True,
    "dyna.rare_share": 0.25, "dyna.eval_every": 1, "agent.output_variance": 1e-4,
    "model.hidden": (64, 64), "model.sum_loss": False, "model.one_hot": True, "model.ensemble": 5,
    "model.one_member": True, "model.spread": 1.0, "model.weight_variance": 1.0,
    "model.optimizer": optax.adam,
    "hparams.agent.learning_rate": 0.05, "hparams.agent.discount": 0.995,
    "hparams.model.learning_rate": 3e-3, "hparams.real_weight": 0.0,
    "hparams.dream.uncertainty_threshold": 0.3})  # fmt: skip
#: as literally as the paper can be read, else its authors' code: ``docs/paper-method.md``
PAPER = changed(TUNED, {
    "preset": "paper", "dream_start": "uniform", "agent.advantage": within_episode,
    "dyna.dream_episodes": 1, "dyna.model_updates": 200, "dyna.model_batch": 5,
    "model.delta": False, "model.normalise": False, "model.spread": 1.0})  # fmt: skip
