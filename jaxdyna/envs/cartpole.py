"""CartPole (Barto, Sutton and Anderson 1983), with the constants and order of Gymnasium's."""

import math
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxdyna.envs.gymnasium import Discrete, spaces
from jaxdyna.fields import setting
from jaxdyna.types import Key, Stepped


@struct.dataclass
class CartPoleParams:
    """What can be swept; SI units and radians."""

    gravity: float = setting(9.8, "Gravity, m/s².")
    masscart: float = setting(1.0, "The cart's mass, kg.", above=0)
    masspole: float = setting(0.1, "The pole's mass, kg.", above=0)
    length: float = setting(0.5, "Half the pole's length, m.", above=0)
    force_mag: float = setting(10.0, "Push to either side, N.")
    tau: float = setting(0.02, "Seconds a step.", above=0)
    theta_threshold: float = setting(
        12 * 2 * math.pi / 360, "The pole's angle beyond which the episode terminates, rad.",
        above=0)  # fmt: skip
    x_threshold: float = setting(
        2.4, "The cart's distance from the middle beyond which it terminates, m.", above=0
    )
    reset_bound: float = setting(0.05, "State variables start uniformly within ± this.", at_least=0)
    max_steps: int = setting(200, "Steps to truncation; 200 is Gym's v0, 500 its v1.", at_least=1)


@struct.dataclass
class CartPoleState:
    """Scalars: position (m), velocity, the pole's angle from upright (rad), its angular velocity,
    and the number of steps taken.
    """

    x: jax.Array
    x_dot: jax.Array
    theta: jax.Array
    theta_dot: jax.Array
    time: jax.Array


@dataclass(frozen=True)
class CartPole(Discrete):
    """Balance a pole on a cart by pushing left (0) or right (1); every step earns 1, the last too.

    The observation is float32 ``[4]``: ``x, x_dot, theta, theta_dot``. Under x64 the state is
    float64 and a step agrees with Gymnasium's to the last bits.
    """

    default_params: ClassVar = CartPoleParams()
    """Gym's CartPole-v0; ``.replace(max_steps=500)`` makes it v1."""
    num_actions: ClassVar = 2
    gymnasium_id: ClassVar = "CartPole-v1"  #: of Gymnasium's own, with another time limit

    def reset(self, key: Key, params: CartPoleParams) -> tuple[jax.Array, CartPoleState]:
        """Starts near the upright standstill: ``obs [4], state``."""
        bound = params.reset_bound
        x, x_dot, theta, theta_dot = jax.random.uniform(key, (4,), minval=-bound, maxval=bound)
        state = CartPoleState(x, x_dot, theta, theta_dot, time=jnp.int32(0))
        return _observe(state), state

    def step(
        self, key: Key, state: CartPoleState, action: jax.Array, params: CartPoleParams
    ) -> Stepped:
        """One Euler step of ``tau`` seconds. Deterministic: ``key`` is not used.

        Returns:
            ``obs [4], state, reward, terminated, truncated, info``; terminated where the cart or
            the pole is beyond its threshold, otherwise truncated at ``max_steps``.
        """
        force = jnp.where(action == 1, params.force_mag, -params.force_mag)
        total_mass = params.masspole + params.masscart
        polemass_length = params.masspole * params.length
        cos, sin = jnp.cos(state.theta), jnp.sin(state.theta)
        temp = (force + polemass_length * jnp.square(state.theta_dot) * sin) / total_mass
        theta_acc = (params.gravity * sin - cos * temp) / (
            params.length * (4.0 / 3.0 - params.masspole * jnp.square(cos) / total_mass)
        )
        x_acc = temp - polemass_length * theta_acc * cos / total_mass
        state = CartPoleState(
            x=state.x + params.tau * state.x_dot,
            x_dot=state.x_dot + params.tau * x_acc,
            theta=state.theta + params.tau * state.theta_dot,
            theta_dot=state.theta_dot + params.tau * theta_acc,
            time=state.time + 1,
        )
        terminated = (jnp.abs(state.x) > params.x_threshold) | (
            jnp.abs(state.theta) > params.theta_threshold
        )
        truncated = ~terminated & (state.time >= params.max_steps)
        return _observe(state), state, jnp.float32(1), terminated, truncated, {}

    def state_of(self, obs: jax.Array) -> CartPoleState:
        """The state that is seen as ``obs [4]`` when an episode starts."""
        x, x_dot, theta, theta_dot = obs
        return CartPoleState(x, x_dot, theta, theta_dot, time=jnp.int32(0))

    def render(self, state: CartPoleState, params: CartPoleParams) -> jax.Array:
        """A side view, uint8 ``[200, 300, 3]``: cart, pole, axle and track on white."""
        width, height, cart_height = 300, 200, 60.0
        scale = width / (2 * params.x_threshold)
        across = jnp.arange(width) + 0.5 - width / 2 - state.x * scale
        up = (height - jnp.arange(height) - 0.5)[:, None] - cart_height
        along = across * jnp.sin(state.theta) + up * jnp.cos(state.theta)
        aside = across * jnp.cos(state.theta) - up * jnp.sin(state.theta)
        half = params.length * scale
        track = (jnp.abs(up) < 0.6) & (jnp.abs(across) < width)
        cart = (jnp.abs(across) < 14) & (jnp.abs(up) < 8)
        pole = (jnp.abs(along - half) < half) & (jnp.abs(aside) < 3)
        axle = jnp.hypot(across, up) < 3.5
        frame = jnp.full((height, width, 3), 255, jnp.uint8)
        layers = (
            (track, (120, 120, 120)),
            (cart, (40, 40, 40)),
            (pole, (202, 152, 101)),
            (axle, (90, 90, 200)),
        )
        for shape, colour in layers:
            frame = jnp.where(shape[..., None], jnp.array(colour, jnp.uint8), frame)
        return frame

    def observation_space(self, params: CartPoleParams) -> spaces.Box:
        """Twice the thresholds, so that the step that terminates lies inside; speeds unbounded."""
        high = np.array(
            [2 * params.x_threshold, np.inf, 2 * params.theta_threshold, np.inf], np.float32
        )
        return spaces.Box(-high, high)


def _observe(state: CartPoleState) -> jax.Array:
    return jnp.stack([state.x, state.x_dot, state.theta, state.theta_dot]).astype(jnp.float32)
