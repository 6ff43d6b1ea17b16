"""Pure environments, registered with Gymnasium when this package is imported."""

from jaxdyna.envs.atari import AtariParams, AtariPong, AtariState
from jaxdyna.envs.cartpole import CartPole, CartPoleParams, CartPoleState
from jaxdyna.envs.catch import Catch, CatchParams, CatchState
from jaxdyna.envs.gxm import Gxm, GxmState, from_gxm
from jaxdyna.envs.gymnasium import HostEnv, HostVectorEnv, register
from jaxdyna.envs.hosted import Hosted, HostedParams, HostedState, from_gymnasium
from jaxdyna.envs.maze import Maze, MazeParams, MazeState
from jaxdyna.envs.pendulum import Pendulum, PendulumParams, PendulumState
from jaxdyna.envs.pong import Pong
from jaxdyna.envs.pong_rules import PongParams, PongState
from jaxdyna.envs.pong_screen import CHANNELS, ObjectMasks, Palette
from jaxdyna.envs.wrappers import Drawn, FrameStack, Replayed, ReplayedParams, StackState

__all__ = [
    "CHANNELS", "AtariParams", "AtariPong", "AtariState", "CartPole", "CartPoleParams",
    "CartPoleState", "Catch", "CatchParams", "CatchState", "Drawn", "FrameStack", "Gxm", "GxmState",
    "HostEnv", "HostVectorEnv", "Hosted", "HostedParams", "HostedState", "Maze", "MazeParams",
    "MazeState", "ObjectMasks", "Palette", "Pendulum", "PendulumParams", "PendulumState", "Pong",
    "PongParams", "PongState", "Replayed", "ReplayedParams", "StackState", "from_gxm",
    "from_gymnasium", "register"]  # fmt: skip

register("jaxdyna/CartPole-v0", CartPole(), CartPoleParams(max_steps=200), reward_threshold=195.0)
register("jaxdyna/CartPole-v1", CartPole(), CartPoleParams(max_steps=500), reward_threshold=475.0)
register("jaxdyna/Maze-v0", Maze(), MazeParams())
register("jaxdyna/Pendulum-v0", Pendulum(), PendulumParams())
register("jaxdyna/Pong-v0", Pong(), PongParams())
register(
    "jaxdyna/Catch-v0", Catch(), CatchParams(), reward_threshold=0.9, max_episode_steps=None
)  # every episode terminates
