"""Pendulum, with the constants and order of Gymnasium's: its action is a torque, of a Box."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.envs.gymnasium import spaces
from jaxdyna.fields import Checked, setting
from jaxdyna.types import Key


@struct.dataclass
class PendulumParams:
    """What can be swept; SI units and radians."""

    gravity: float = setting(10.0, "Gravity, m/s².")
    mass: float = setting(1.0, "The rod's mass, kg.", above=0)
    length: float = setting(1.0, "The rod's length, m.", above=0)
    tau: float = setting(0.05, "Seconds a step.", above=0)
    max_speed: float = setting(8.0, "Angular velocity is clipped to ± this, rad/s.", above=0)
    angle_bound: float = setting(math.pi, "Angles start uniformly within ± this, rad.", at_least=0)
    speed_bound: float = setting(1.0, "Angular velocities likewise, rad/s.", at_least=0)
    max_steps: int = setting(200, "Steps to truncation.", at_least=1)


@struct.dataclass
class PendulumState:
    """Scalars: the angle from upright (rad), anticlockwise, never wrapped; the angular velocity;
    and the number of steps taken.
    """

    theta: jax.Array
    theta_dot: jax.Array
    time: jax.Array


@dataclass(frozen=True)
class Pendulum(Checked):
    """Swing a rod up by a torque ``[1]`` too small to lift it, and hold it upright: every step
    costs the square of its angle, a tenth of its speed's and a thousandth of the torque's.

    The observation is float32 ``[3]``: the angle's cosine and sine, and the angular velocity.
    Nothing terminates. Under x64 a step agrees with Gymnasium's to the last bits.
    """

    max_torque: float = setting(2.0, "Torque is clipped to ± this, N m.", above=0)

    default_params: ClassVar = PendulumParams()
    gymnasium_id: ClassVar = "Pendulum-v1"
    """Of Gymnasium's own."""

    def reset(self, key: Key, params: PendulumParams) -> tuple[jax.Array, PendulumState]:
        """Starts anywhere, slowly: ``obs [3], state``."""
        bounds = jnp.stack([jnp.float32(params.angle_bound), jnp.float32(params.speed_bound)])
        theta, theta_dot = bounds * jax.random.uniform(key, (2,), jnp.float32, -1, 1)
        state = PendulumState(theta, theta_dot, time=jnp.int32(0))
        return _observe(state), state

    def step(
        self, key: Key, state: PendulumState, action: jax.Array, params: PendulumParams
    ) -> tuple[jax.Array, PendulumState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One step of ``tau`` seconds. Deterministic: ``key`` is not used.

        Returns:
            ``obs [3], state, reward, terminated, truncated, info``.
        """
        torque = jnp.clip(action[0], -self.max_torque, self.max_torque)
        angle = (state.theta + jnp.pi) % (2 * jnp.pi) - jnp.pi
        speed = state.theta_dot
        cost = jnp.square(angle) + 0.1 * jnp.square(speed) + 0.001 * jnp.square(torque)
        gravity = 3 * params.gravity / (2 * params.length) * jnp.sin(state.theta)
        push = 3.0 / (params.mass * params.length**2) * torque
        speed = speed + (gravity + push) * params.tau
        speed = jnp.clip(speed, -params.max_speed, params.max_speed)
        state = PendulumState(state.theta + speed * params.tau, speed, state.time + 1)
        truncated = state.time >= params.max_steps
        return _observe(state), state, -cost, jnp.bool_(False), truncated, {}

    def state_of(self, obs: jax.Array) -> PendulumState:
        """The state that is seen as ``obs [3]`` when an episode starts."""
        return PendulumState(jnp.arctan2(obs[1], obs[0]), obs[2], time=jnp.int32(0))

    def render(self, state: PendulumState, params: PendulumParams) -> jax.Array:
        """Rod and axle on white, uint8 ``[200, 200, 3]``."""
        size = 200
        metres = ((jnp.arange(size) + 0.5) / size - 0.5) * 4.4 * params.length
        right, up = metres[None], -metres[:, None]
        along = up * jnp.cos(state.theta) - right * jnp.sin(state.theta)
        aside = right * jnp.cos(state.theta) + up * jnp.sin(state.theta)
        beyond = along - jnp.clip(along, 0, params.length)
        rod = jnp.hypot(beyond, aside) < 0.1 * params.length
        axle = jnp.hypot(right, up) < 0.05 * params.length
        frame = jnp.full((size, size, 3), 255, jnp.uint8)
        frame = jnp.where(rod[..., None], jnp.array((204, 77, 77), jnp.uint8), frame)
        return jnp.where(axle[..., None], jnp.array((0, 0, 0), jnp.uint8), frame)

    def observation_space(self, params: PendulumParams) -> spaces.Box:
        """The unit circle and the speeds."""
        high = np.array([1, 1, params.max_speed], np.float32)
        return spaces.Box(-high, high)

    def action_space(self, params: PendulumParams) -> spaces.Box:
        """The torques."""
        return spaces.Box(-self.max_torque, self.max_torque, (1,), np.float32)


def _observe(state: PendulumState) -> jax.Array:
    seen = [jnp.cos(state.theta), jnp.sin(state.theta), state.theta_dot]
    return jnp.stack(seen).astype(jnp.float32)
