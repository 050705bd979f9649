"""Maze2D: a ball pushed through a maze by a bounded force (Gymnasium-Robotics PointMaze).

Cell centres lie at x = column + 0.5 - W / 2, y = H / 2 - row - 0.5 (metres). Walls are unit boxes.
The force is in [-1, 1] on each axis, and the speed is clipped at 5 m/s on each axis.
"""

import contextlib
import heapq
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.tasks.protocol import Control, Tolerances

Cell = tuple[int, int]
DT = 0.01  # s
BALL_RADIUS = 0.1  # m
MAX_SPEED = 5.0  # m/s on each axis
ACCELERATION = 23.82  # m/s^2 per unit of force, from the fit v' = 0.9976 v + 0.2382 u
SUCCESS_RADIUS = 0.45  # m, PointMaze's own success test
BRAKING = 16.0  # m/s^2, deceleration that demonstrations plan with


@dataclass(frozen=True)
class Maze2D:
    """One maze.

    rows     map of the cells: '#' is a wall, ' ' is free
    switch   range of the distance [m] at which a demonstration turns to its next waypoint; small
             distances run wide in corners
    """

    name: str
    env_id: str
    horizon: int
    rows: tuple[str, ...]
    switch: tuple[float, float] = (0.5, 0.5)

    layout = ("x", "y", "vx", "vy")
    units = ("m", "m", "m/s", "m/s")
    positions = ("x", "y")
    velocities = ("vx", "vy")
    shared_scale = (("x", "y"), ("vx", "vy"))
    dt = DT
    control: ClassVar[Control] = "open_loop"
    tolerances = Tolerances()
    footprint = BALL_RADIUS
    success_radius = SUCCESS_RADIUS

    def make_env(self, render: bool = False, max_steps: int = 10**9) -> Any:
        """The Gymnasium environment; it never resets the goal by itself."""
        with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")  # the import warns of versions of other environments
            import gymnasium
            import gymnasium_robotics

            gymnasium.register_envs(gymnasium_robotics)
        return gymnasium.make(
            self.env_id,
            continuing_task=True,
            reset_target=False,
            max_episode_steps=max_steps,
            render_mode="rgb_array" if render else None,
        )

    def observe(self, obs: Any) -> Array:
        """State (x, y, vx, vy) of an observation, or states of an episode of observations."""
        return np.asarray(obs["observation"] if isinstance(obs, dict) else obs, dtype=np.float64)

    def reset_to(self, env: Any, start: Array, goal: Array, seed: int) -> Any:
        """Put the ball into a start state and the goal at another; returns the observation."""
        env.reset(seed=seed)
        env.goal = goal[:2].copy()
        env.update_target_site_pos()
        env.point_env.set_state(start[:2].copy(), start[2:].copy())
        state, _ = env.point_env._get_obs()
        return env._get_obs(state)

    def track(self, state: Array, target: Array) -> Array:
        """Force of the waypoint controller: 20 (p' - p) + 2 (v' - v), clipped to [-1, 1]."""
        error = target - state
        return np.clip(20.0 * error[:2] + 2.0 * error[2:], -1.0, 1.0).astype(np.float32)

    def from_d4rl(self, states: Array) -> Array:
        """D4RL's states (row, column, their rates) as (x, y, vx, vy); its cells lie 0.2 lower."""
        row, col, v_row, v_col = states.T
        x = col + 0.2 + 0.5 - len(self.rows[0]) / 2
        y = len(self.rows) / 2 - 0.5 - (row + 0.2)
        return np.stack((x, y, v_col, -v_row), axis=1)

    # geometry ----------------------------------------------------------------------------------

    def centre(self, cell: Cell) -> Array:
        """Centre (x, y) of a cell (row, column)."""
        row, col = cell
        return np.array([col + 0.5 - len(self.rows[0]) / 2, len(self.rows) / 2 - row - 0.5])

    def cell(self, point: Array) -> Cell:
        """Cell (row, column) of a point (x, y)."""
        row = int(np.floor(len(self.rows) / 2 - point[1]))
        return row, int(np.floor(point[0] + len(self.rows[0]) / 2))

    def cells(self, kind: str) -> list[Cell]:
        """All cells of a kind: '#' or ' '."""
        return [(r, c) for r, row in enumerate(self.rows) for c, k in enumerate(row) if k == kind]

    def walls(self) -> Array:
        """Boxes (x_min, y_min, x_max, y_max) of the walls [n, 4]."""
        centres = np.array([self.centre(cell) for cell in self.cells("#")])
        return np.concatenate((centres - 0.5, centres + 0.5), axis=1)

    def is_free(self, point: Array, clearance: float = 0.0) -> bool:
        """Whether a ball of radius clearance at the point is in the maze and touches no wall."""
        row, col = self.cell(point)
        if not (0 <= row < len(self.rows) and 0 <= col < len(self.rows[0])):
            return False
        box = self.walls()
        nearest = np.clip(point, box[:, :2], box[:, 2:])
        return bool(np.linalg.norm(nearest - point, axis=1).min() > clearance)

    def route(
        self, start: Array, goal: Array, cost: Callable[[Cell], float] = lambda _: 1.0
    ) -> list[Cell]:
        """Cells of a cheapest path over free cells (Dijkstra), both ends included.

        cost   cost of entering a cell
        """
        source, target = self.cell(start), self.cell(goal)
        free = set(self.cells(" "))
        for point, cell in ((start, source), (goal, target)):
            if cell not in free:
                x, y = point[:2]
                raise CdiffError(
                    f"no route in {self.name}: the point ({x:g}, {y:g}) lies in a wall"
                )
        previous: dict[Cell, Cell | None] = {}
        queue: list[tuple[float, Cell, Cell | None]] = [(0.0, source, None)]
        while queue:
            total, cell, before = heapq.heappop(queue)
            if cell in previous:
                continue
            previous[cell] = before
            if cell == target:
                break
            row, col = cell
            for neighbour in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
                if neighbour in free and neighbour not in previous:
                    heapq.heappush(queue, (total + cost(neighbour), neighbour, cell))
        path: list[Cell] = []
        step: Cell | None = target
        while step is not None:
            path.append(step)
            step = previous[step]
        return path[::-1]

    def path_length(self, start: Array, goal: Array) -> float:
        """Length [m] of a shortest route through cell centres.

        In its first and last cell the route leads straight from the start and to the goal.
        """
        inner = [self.centre(cell) for cell in self.route(start, goal)[1:-1]]
        points = np.array([start, *inner, goal])
        return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())

    def random_point(self, rng: np.random.Generator, spread: float = 0.3) -> Array:
        """A point within spread [m] of the centre of a random free cell, on each axis."""
        free = self.cells(" ")
        return self.centre(free[rng.integers(len(free))]) + rng.uniform(-spread, spread, 2)

    # demonstrations ----------------------------------------------------------------------------

    def demonstrate(
        self, n_steps: int, seed: int, episode_steps: int = 2000
    ) -> Iterator[dict[str, Any]]:
        """Episodes of trips from rest to rest by a waypoint controller.

        There are n_steps environment steps in all. A trip goes to a random point along a shortest
        route over randomly weighted cells. Its waypoints are jittered by 0.15 m, its top speed is
        random, and smooth random forces are added. A trip ends with a hold of random length, so
        that plans pinned at rest lie in the data.
        """
        rng = np.random.default_rng(seed)
        env = self.make_env().unwrapped
        for first in range(0, n_steps, episode_steps):
            obs, _ = env.reset(seed=int(rng.integers(2**31)))
            steps = min(episode_steps, n_steps - first)
            rows: dict[str, list[Any]] = {"observations": [obs], "actions": [], "rewards": []}
            while len(rows["actions"]) < steps:
                goal = self.random_point(rng)
                env.goal = goal
                for u in self._trip(partial(_last_state, rows), goal, rng):
                    obs, reward, _, _, _ = env.step(u.astype(np.float32))
                    rows["observations"].append(obs)
                    rows["actions"].append(u.astype(np.float32))
                    rows["rewards"].append(reward)
                    if len(rows["actions"]) == steps:
                        break
            yield rows
        env.close()

    def _trip(
        self, state: Callable[[], Array], goal: Array, rng: np.random.Generator
    ) -> Iterator[Array]:
        """Forces of one trip from the present state to rest at the goal, and of the hold.

        state   returns the present state [4]
        """
        weights: dict[Cell, float] = {}
        route = self.route(
            state()[:2], goal, lambda cell: weights.setdefault(cell, rng.uniform(1.0, 1.6))
        )
        points = [*(self.centre(cell) + rng.uniform(-0.15, 0.15, 2) for cell in route[1:-1]), goal]
        speeds = rng.uniform(2.8, 5.0), rng.uniform(2.0, 3.4)
        near, far = self.switch
        turn_at = near if near == far else rng.uniform(near, far)
        drift, hold = np.zeros(2), int(rng.integers(0, 160))
        while hold >= 0:
            x = state()
            p, v = x[:2], x[2:]
            while len(points) > 1 and np.hypot(*(points[0] - p)) < turn_at:
                points.pop(0)
            d = points[0] - p
            distance = float(np.hypot(*d))
            hold -= len(points) == 1 and distance < 0.08
            drift = 0.9 * drift + rng.normal(0.0, 0.08, 2)
            velocity = d * (_trip_speed(points, d, speeds, turn_at) / max(distance, 1e-9))
            yield np.clip((velocity - v) * 0.6 + drift * min(1.0, distance / 0.3), -1.0, 1.0)


def _last_state(rows: dict[str, list[Any]]) -> Array:
    return rows["observations"][-1]["observation"]


def _trip_speed(
    points: Sequence[Array], d: Array, speeds: tuple[float, float], turn_at: float
) -> float:
    """Speed [m/s] on the way to the first of the points, d [m] away.

    It falls in time to rest at the last point, or to the speed of the turn at the first.

    speeds    top speed, and speed in a right-angled corner
    turn_at   distance at which the turn starts
    """
    top, corner = speeds
    distance = float(np.hypot(*d))
    if len(points) == 1:
        return float(min(top, 9.0 * distance, np.sqrt(2 * BRAKING * distance)))
    after = points[1] - points[0]
    straight = max(0.0, float(d @ after) / max(distance * np.hypot(*after), 1e-9))
    turn = corner + straight * (top - corner)
    return float(min(top, np.sqrt(turn**2 + 2 * BRAKING * max(distance - turn_at, 0.0))))


UMAZE = Maze2D(
    "maze2d-umaze",
    "PointMaze_UMaze-v3",
    128,
    ("#####", "#   #", "### #", "#   #", "#####"),
    (0.05, 0.25),
)
LARGE = Maze2D(
    "maze2d-large",
    "PointMaze_Large-v3",
    384,
    (
        "############",
        "#    #     #",
        "# ## # # # #",
        "#      #   #",
        "# #### ### #",
        "#  # #     #",
        "## # # # ###",
        "#  #   #   #",
        "############",
    ),
)
