"""The arms of learning to act, what is kept of their episodes, and what is judged of them. Dreams
of all arms begin where those of ``dyna`` do and are as many and as long.

The goal is 30 steps from the start. A planner without a value must look further ahead than that;
on learned frames that costs seconds a decision, so planners look a few steps ahead and take the
agent's values for what comes after: the learner, which is off-policy, learns from what they play.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxdyna import losses, networks, planners
from jaxdyna.agents import CloningConfig, DQNConfig, DQNState, cloning, dqn, q_values, real_memory
from jaxdyna.dyna import Dyna, DynaConfig, DynaHParams, Metrics
from jaxdyna.dyna.experts import acting, by_values
from jaxdyna.dyna.frames import Recorded, frame_dyna, true_dyna
from jaxdyna.envs import FrameStack, Maze, MazeParams, MazeState
from jaxdyna.envs.maze import MOVES
from jaxdyna.experiments.maze.options import MazeOptions
from jaxdyna.experiments.study import arms as study
from jaxdyna.experiments.study.accuracy import on_common
from jaxdyna.models import PixelConfig, pixels
from jaxdyna.optimizers import decayed_adam
from jaxdyna.rollout import rollout
from jaxdyna.types import Agent, Key, Transition

STARTS, AT_ONCE = 1000, 100
JUDGED = 2
DRIFT = (0.1, 0.35, 0.35, 0.1, 0.1)  #: odds of the moves of a policy that drifts to the goal
SAID = study.SAID | {
    "mpc": "after the first N episodes the best of random action sequences in the learned model "
    "acts, the agent's values for what comes after them. No dreams.",
    "mcts": "likewise MuZero's tree search, the agent's values at its leaves and for its prior's "
    "log odds. No dreams.",
    "mpc_init": "`mpc` plays some episodes, which the agent learns from and imitates by a margin "
    "loss, in as many updates as `dyna` makes on dreams; it goes on with as many updates at the "
    "same times as `dyna`, all of them on real steps.",
}


def arms(options: MazeOptions, judged: bool = True) -> dict[str, study.Made]:
    """What makes each arm; ``judged``: and judges its policy in the end."""
    maze, agent, model = Maze(options.size, options.obstacles), agent_of(options), model_of(options)
    dreamless = replace(options.dyna, dream_updates=0)
    hooks = study.Hooks(judge if judged else None, piece=10, block=options.block)
    common = options.steps if options.judged_on == "common" else None
    first = options.dream_start == "observed"
    dyna = parts(maze, agent, model, common, first=first)
    made = study.standard_arms(
        dyna, options.dyna, options.hparams, true_dyna(dyna, first), hooks,
        busier=parts(maze, study.busy(agent, options.dyna), model).agent)  # fmt: skip

    def planned(make: Any, settings: Any) -> Any:
        playing = acting(dyna, make, settings, by_values(agent))._replace(dream=None)
        return study.dyna_arm(playing, dreamless, options.hparams, hooks)

    def shown() -> Any:
        own, count = parts(maze, agent, model, common, shared=None), options.shown_episodes
        imitating = own._replace(agent=imitator(own, agent, options.cloning))
        shooting = planners.random_shooting, options.mpc, by_values(agent), count
        after = options.dyna.num_real_first + count
        late = replace(study.all_real(options.hparams), num_real_first=after, model_trains=True)
        return study.dyna_arm(acting(imitating, *shooting), options.dyna, late, hooks)

    return made | {
        "mpc": lambda: planned(planners.random_shooting, options.mpc),
        "mcts": lambda: planned(planners.muzero, options.mcts),
        "mpc_init": shown,
    }


def agent_of(options: MazeOptions) -> DQNConfig:
    """DQN's counts and network, with room for what a run can add to its replays and no more."""
    network: Any = networks.GlimpseQ(len(MOVES))
    if options.network != "glimpse":
        kinds: Any = {"plain": networks.PlainQ, "convolutions": networks.ConvolutionalQ}
        network = kinds[options.network](len(MOVES), options.convolutions, options.dense)
    return replace(study.sized(options.agent, options.dyna), network=network)


def model_of(options: MazeOptions) -> PixelConfig:
    """The model's network, loss, optimiser; the paper's threshold 0.2 serves its cross-entropy."""
    loss = {"bce": losses.bce, "l1": losses.l1, "l2": losses.l2}[options.model_loss]
    head: Any = networks.LocalReward()
    if options.model_reward == "classes":
        params = options.hparams.env
        rewards = (float(params.collision_reward), 0.0, float(params.goal_reward))
        head = networks.ClassReward(rewards, options.reward_weights, options.reward_hidden)
    weighed: dict[str, Any] = {"reward": head, "reward_weight": options.reward_weight}
    if options.model == "local":
        return PixelConfig(networks.LocalDynamics(3, options.model_widths), loss, **weighed)
    sizes = options.coder_widths, options.coder_kernels, options.coder_dense
    return PixelConfig(
        networks.EncoderDecoder(3, *sizes), loss, 0.2 if loss is losses.bce else 0.5, **weighed,
        optimizer=decayed_adam(options.coder_decay) if options.coder_decay else optax.adam,
    )  # fmt: skip


@cache
def parts(
    maze: Maze, agent: DQNConfig, model: PixelConfig, common: int | None = None,
    shared: Any = real_memory, first: bool = False,
) -> Dyna:  # fmt: skip
    """The parts of ``dyna``: one object, and so one program, for the same settings. Its model is
    judged on `common_transitions` of so many steps, if any; the rest is `frame_dyna`'s.
    """
    env, shape = FrameStack(maze), (maze.size, maze.size, 3)
    learner, learned = dqn(shape, len(MOVES), agent), pixels(shape, len(MOVES), model)
    dyna = frame_dyna(env, learner, learned, partial(behaviour, maze), shared, first)
    return dyna if common is None else on_common(dyna, common_transitions(env, common))


@cache
def imitator(dyna: Dyna, config: DQNConfig, imitation: CloningConfig) -> Agent:
    """The agent of ``dyna``, which imitates what it is shown."""
    stack = dyna.env.observation_space(dyna.env.default_params).shape
    example = jax.ShapeDtypeStruct(stack, np.uint8), jax.ShapeDtypeStruct((), np.int32)

    def values(params: Any, obs: jax.Array) -> jax.Array:
        return q_values(config.network, params, obs[None])[0]

    def install(state: DQNState, params: Any) -> DQNState:
        return replace(state, params=params, target=jax.tree.map(jnp.copy, params))

    return cloning(dyna.agent, values, example, imitation, install)


def behaviour(maze: Maze, real: Transition, recorded: Recorded, params: MazeParams) -> Metrics:
    """What a real episode ``[1, T]`` was like: ``optimal_return``, the most that was to be had;
    ``collisions``; ``time_to_goal``, the steps until it is first reached, one more than the episode
    has where it is not; what `held_back` counts.
    """
    steps = real.action.shape[1]
    state, info = jax.tree.map(lambda leaf: leaf[0], recorded)
    start = jax.tree.map(lambda leaf: leaf[0], state)
    reached = jnp.where(info["at_goal"].any(), jnp.argmax(info["at_goal"]), steps) + 1
    way = jnp.arange(steps) < reached
    return held_back(maze, state, real.action[0], way) | {
        "optimal_return": planners.solve_maze(maze, start, params, steps).best_return,
        "collisions": info["collision"].sum().astype(jnp.float32),
        "time_to_goal": reached.astype(jnp.float32),
    }


def held_back(maze: Maze, states: MazeState, actions: jax.Array, way: jax.Array) -> Metrics:
    """Who waits for an obstacle, of an episode's states before each step and its actions ``[T]``,
    over the steps ``way``, bool ``[T]``, to the goal.

    Returns:
        ``threats``: steps in which a move that comes closer to the goal would have ended on an
        obstacle; ``waits``: those of them in which the agent did not come closer; ``dawdles``:
        other steps in which it did not.
    """
    moves = jnp.array(MOVES)

    def step(state: MazeState) -> tuple[jax.Array, jax.Array]:
        landing = jnp.clip(state.agent + moves, 0, maze.size - 1)
        obstacles, _ = maze.patrol(state.obstacles, state.directions)
        hit = (landing[:, None] == obstacles).all(-1).any(-1)
        closer = abs(landing - state.goal).sum(-1) < abs(state.agent - state.goal).sum()
        return closer, (closer & hit).any()

    closer, threat = jax.vmap(step)(states)
    back = way & ~jnp.take_along_axis(closer, actions[:, None].astype(int), axis=1)[:, 0]
    counted = {"threats": way & threat, "waits": back & threat, "dawdles": back & ~threat}
    return {name: these.sum(dtype=jnp.float32) for name, these in counted.items()}


@cache
def common_transitions(env: FrameStack, steps: int) -> Transition:
    """The same new transitions for every model, ``[2 * JUDGED, T]``: episodes of a uniformly random
    policy, and of one that drifts to the goal.
    """

    def play(key: Key, odds: jax.Array) -> Transition:
        def act(obs: jax.Array, key: Key) -> jax.Array:
            return jax.random.categorical(key, jnp.log(odds))

        return rollout(env, act, key, MazeParams(max_steps=steps), JUDGED, num_steps=steps)

    keys = jax.random.split(jax.random.key(2**20), 2)
    odds = jnp.array([len(MOVES) * [1 / len(MOVES)], DRIFT])
    played = jax.jit(jax.vmap(play))(keys, odds)
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), played)


def judge(dyna: Dyna, config: DynaConfig, state: Any, key: Key, hparams: DynaHParams) -> Metrics:
    """The final greedy policy on new starts: ``greedy_return``, ``greedy_optimal``, the most that
    was to be had, and ``greedy_collisions``, each ``[starts]``.
    """
    params, steps = hparams.env, config.num_steps
    env: Any = dyna.env
    act = study.greedy_policy(dyna, state, hparams)

    def some(key: Key) -> Metrics:
        played, seen = rollout(env, act, key, params, AT_ONCE, num_steps=steps, record=dyna.record)
        starts = jax.tree.map(lambda leaf: leaf[:, 0], seen.state)
        plans = jax.vmap(lambda start: planners.solve_maze(env.env, start, params, steps))(starts)
        return {
            "greedy_return": played.reward.sum(-1),
            "greedy_optimal": plans.best_return,
            "greedy_collisions": seen.info["collision"].sum(-1),
        }

    judged = jax.lax.map(some, jax.random.split(key, STARTS // AT_ONCE))
    return jax.tree.map(jnp.ravel, judged)
