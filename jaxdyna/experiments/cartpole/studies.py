"""Studies: what the paper leaves open, what makes ``lean`` lean, what a worse model costs."""

import math
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

from jaxdyna.agents.reinforce import over_batch, within_episode
from jaxdyna.experiments.cartpole.acting import CARTPOLE
from jaxdyna.experiments.cartpole.arms import arms
from jaxdyna.experiments.cartpole.options import rule
from jaxdyna.experiments.engine import Study
from jaxdyna.experiments.report import frozen, sections as report
from jaxdyna.experiments.report.rows import rows
from jaxdyna.experiments.report.summaries import first_dreams
from jaxdyna.experiments.study.accuracy import Measure, accuracy, describe
from jaxdyna.experiments.study.grids import baselines, grid

Rows = dict[str, dict[str, Any]]
OF = replace(CARTPOLE, arms=partial(arms, judged=False), describe=(first_dreams,))
LITERAL: dict[str, Any] = {"model.normalise": False, "model.delta": False}
MEAN: dict[str, Any] = {"model.sum_loss": False}
CONTROLS: Rows = {
    "true environment as the model": {"arm": "oracle"},
    "untrained model (placebo)": {"arm": "placebo"},
    "model-free": {"arm": "model_free"},
}
SHORT = "fake episodes of at most"

READ: Rows = {
    "dyna (tuned preset)": {},
    "returns standardised within an episode": {"agent.advantage": within_episode},
    "returns standardised over the batch": {"agent.advantage": over_batch},
    "2 updates on 1 fake episode each": {"dyna.dream_episodes": 1},
    "16 updates on 1 fake episode each": {"dyna.dream_updates": 16, "dyna.dream_episodes": 1},
    "4 fake episodes an update": {"dyna.dream_episodes": 4},
    "4 updates on dreams": {"dyna.dream_updates": 4},
    "targets are next states": {"model.delta": False},
    "scaled by 1 standard deviation, not 3": {"model.spread": 1.0},
    "no normalisation": {"model.normalise": False},
    "no normalisation, next states": LITERAL,
    "no normalisation, next states, mean of the batch": LITERAL | MEAN,
    "Eq. 1 as a mean of the batch": MEAN,
    "the same, scaled by 1, next states": MEAN | {"model.spread": 1.0, "model.delta": False},
    "batch of 5": {"dyna.model_batch": 5},
    "LeCun initial weights": {"model.weight_variance": 1.0},
    "20 model updates": {"dyna.model_updates": 20},
    "fake episode ends at p > 0.03": {"hparams.dream.termination_threshold": 0.03},
    "fake episode ends at p > 0.5": {"hparams.dream.termination_threshold": 0.5},
    "dreams start uniform ±0.1": {"dream_start": "uniform"},
    "replay emptied every 20 episodes": {"forget_every": 20},
    "authors' slip: angle overwritten": {"authors_bug": True},
    "true environment as the model": {"arm": "oracle"},
    "true environment, 2 updates on 1 fake episode each": {
        "arm": "oracle", "dyna.dream_episodes": 1,
    },
    **{f"model-free, learning rate {rate}":
       {"arm": "model_free", "hparams.agent.learning_rate": rate}
       for rate in (0.005, 0.01, 0.015, 0.02)}}  # fmt: skip
LEVER: Rows = {
    "dyna (lean preset)": {},
    "N = 1": {"dyna.num_real_first": 1},
    "N = 10": {"dyna.num_real_first": 10},
    "one network, no disagreement": {"model.ensemble": 1},
    "5 networks, disagreement ignored": {"hparams.dream.uncertainty_threshold": math.inf},
    "3 networks": {"model.ensemble": 3},
    "each step by the mean of the networks": {"model.one_member": False},
    "policy begins with LeCun's weights": {"agent.output_variance": 1.0},
    "fake episode ends at p > 0.5": {"hparams.dream.termination_threshold": 0.5},
    "ends drawn as rarely as they come": {"dyna.rare_share": None},
    "targets are next states": {"model.delta": False},
    "200 model updates": {"dyna.model_updates": 200},
    "20 updates on dreams": {"dyna.dream_updates": 20},
    "4 fake episodes an update": {"dyna.dream_episodes": 4},
    "returns standardised within an episode": {"agent.advantage": within_episode},
    "learns from real episodes too": {"hparams.real_weight": 1.0},
    "never rests": {"rest_when_safe": False},
    "dreams branch off real states, 50 steps": {"dream_start": "branched", "dyna.dream_steps": 50},
    "learning rate 0.02": {"hparams.agent.learning_rate": 0.02},
    "untrained model, learns from real episodes too": {
        "arm": "placebo",
        "hparams.real_weight": 1.0,
    },
    **CONTROLS,
}
WORSE: Rows = {
    "dyna (tuned preset)": {},
    **{f"noise of {noise} standard deviations on predictions": {"dream_noise": noise}
       for noise in (0.01, 0.03, 0.1, 0.3)},
    **{f"hidden layers of {width}": {"model.hidden": (width, width)} for width in (64, 16, 4)},
    **{f"{count} model updates an episode": {"dyna.model_updates": count} for count in (20, 5, 2)},
    "the newest 200 transitions only": {"dyna.replay_capacity": 200},
    **{f"{SHORT} {steps} steps": {"dyna.dream_steps": steps} for steps in (100, 50, 25)},
    **CONTROLS}  # fmt: skip
ALONE = baselines(
    "dqn", "dqn_hparams", ratios=(0.5, 1, 2, 4),
    between=40_000,  # twice the rule's window: where networks begin anew in it nothing solves
    said=lambda ratio: {"dqn.updates_per_step": float(ratio)})  # fmt: skip
DREAMING: Rows = {
    f"updates {updates}, dreams {dreams}, rate {rate:g}": {
        "dyna.dream_updates": updates, "dyna.dream_episodes": dreams,
        "hparams.agent.learning_rate": rate,
    }
    for updates, dreams, rate in product((1, 2, 4, 8), (8, 16), (0.005, 0.01, 0.02, 0.04))
}  # fmt: skip
MEASURE = Measure(
    curve="model_error", episodes=100, hollow=SHORT,
    axis="squared error over the mean square of a step's change (logarithmic)",
    said="The error is the squared error one step ahead over the mean square of a step's change, "
    "averaged over the state's variables; within 0.2% the share of its variance that is left "
    "unexplained. Every model is judged on the same new transitions: a third each from a "
    "controller that balances the pole, from one with 30% of its actions at random, and from "
    "random actions alone.",
    lines=("true environment as the model", "model-free"))  # fmt: skip

READINGS = Study(
    name="readings",
    title="Which reading of the paper gives its effect on CartPole?",
    of=OF, preset="tuned", rows=lambda options: READ,
    common={"episodes": 600, "stop_after_solved": 0, "dyna.eval_every": 0},
    sections=(rows(), report.settings, report.spent))  # fmt: skip
LEVERS = Study(
    name="levers",
    title="What makes the lean preset lean on CartPole?",
    of=replace(OF, describe=(first_dreams, frozen.describe(rule))),
    preset="lean", rows=lambda options: LEVER, common={"seeds": 20, "episodes": 30},
    sections=(rows("frozen.real_steps_to_solve"), report.settings, report.spent))  # fmt: skip
ACCURACY = Study(
    name="accuracy",
    title="Does sample efficiency grow with the model's accuracy?",
    of=OF, preset="tuned", rows=lambda options: WORSE,
    common={
        "episodes": 500, "stop_after_solved": 0, "judged_on": "common", "dyna.eval_every": 0,
    },
    describe=(describe(MEASURE),),
    sections=(rows(), accuracy(MEASURE), report.settings, report.spent))  # fmt: skip
BASELINES = grid(
    "baselines", "The strongest agent without a model on CartPole", OF, "dqn", lambda options: ALONE
)
DYNA_GRID = grid(
    "dyna_grid", "Dyna on CartPole, with as many settings", OF, "dyna", lambda options: DREAMING
)
