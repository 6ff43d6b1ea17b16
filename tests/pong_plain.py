"""Pong's rules once more, in plain Python, one frame at a time, for the tests to compare with."""

import math
from dataclasses import dataclass

import numpy as np

ABSENT, SERVE = -48, (80, 79)
TOP, BOTTOM, LEFT, RIGHT = -3, 158, 3, 156
OWN_COLUMN, OPPONENT_COLUMN = 140, 16
STICK = {0: 0, 1: 0, 2: -1, 3: 1, 4: -1, 5: 1}
FIRE = (1, 4, 5)


@dataclass
class PlainPong:
    """One game; the fields are those of `PongState`, pairs as tuples, and ``params``."""

    ball: tuple
    ball_velocity: tuple
    own: int
    own_target: float
    opponent: int
    score: tuple
    wait: int
    last_action: int
    clock: int
    params: object

    def frame(self, action, upwards, sticks):
        """One frame; what is random is given."""
        fired, action = self.last_action in FIRE, self.last_action if sticks else action
        in_play, served = self.wait == 0, False
        if not in_play:
            self.wait -= 1
            self.ball, served = (ABSENT, 0), self.wait == 0
            if served:
                self.ball_velocity = (-1 if upwards else 1, self.ball_velocity[1])
                self.ball = tuple(map(sum, zip(SERVE, self.ball_velocity, strict=True)))
        elif self.ball[1] >= RIGHT or self.ball[1] <= LEFT:
            lost = self.ball[1] >= RIGHT
            self.score = (self.score[0] + lost, self.score[1] + (not lost))
            self.ball_velocity = (0, 1 if lost else -1)
            self.wait = max(self.params.serve_delay, 1)
        else:
            self._fly(fired)
        self.clock += 1
        self._move_own(action)
        self._move_opponent(served)
        self.last_action = action

    def picture(self, scale):
        """The field with each object in a channel of its own, the ball in front."""
        frame = np.zeros((160 // scale, 160 // scale, 3), np.uint8)
        for channel, (row, column), (height, width) in (
            (0, (self.opponent, OPPONENT_COLUMN), (16, 4)),
            (1, (self.own - self.own % 2, OWN_COLUMN), (16, 4)),
            (2, self.ball, (4, 2)),
        ):
            rows = [one for one in range(row, row + height) if 0 <= one < 160]
            columns = [one for one in range(column, column + width) if 0 <= one < 160]
            for place in {(down // scale, right // scale) for down in rows for right in columns}:
                frame[place] = np.eye(3, dtype=np.uint8)[channel] * 255
        return frame

    def _fly(self, fired):
        (row, column), (down, right) = self.ball, self.ball_velocity
        own = self._touches(self.own - self.own % 2, OWN_COLUMN)
        other = self._touches(self.opponent - 1, OPPONENT_COLUMN)
        if own or other:
            place = row - self.own if own else row - self.opponent - 2
            down = min(max(place // 4 - 1, -3), 2)
        if own:
            right = -min(abs(right) + fired, 3)
        elif other:
            right = min(abs(right), 3)
        if row <= TOP:
            down, row = abs(self.ball_velocity[0]), row + 1
        elif row >= BOTTOM:
            down, row = -abs(self.ball_velocity[0]), row - 1
        self.ball_velocity, self.ball = (down, right), (row + down, column + right)

    def _touches(self, top, left):
        """Whether the ball, 4 pixels high and 2 wide, shares one with a paddle, 16 high and 4
        wide; not while it is at a wall.
        """
        row, column = self.ball
        rows = set(range(row, row + 4)) & set(range(top + 1, top + 16))
        columns = set(range(column, column + 2)) & set(range(left, left + 4))
        return bool(rows and columns) and TOP < row < 159

    def _move_own(self, action):
        target = np.float32(self.own_target) + np.float32(STICK[action] * self.params.paddle_speed)
        self.own_target = min(max(float(target), -34.0), 160.0)
        if self.clock % 2 == 0:
            half = math.floor((self.own_target - self.own) / 2)
            self.own = min(max(self.own + half, -9), 156)

    def _move_opponent(self, served):
        aim = self.ball[0] - 1
        if served:
            self.opponent = 81 if self.ball_velocity[0] > 0 else 77
        elif self.clock % self.params.opponent_rest:
            way = (aim > self.opponent) - (aim < self.opponent)
            self.opponent += way * self.params.opponent_speed
