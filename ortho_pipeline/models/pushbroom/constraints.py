r"""Prior knowledge of a satellite's path and attitude, as pseudo-observations.

- `Observations`: a vendor's tables (positions, angles, or their rates), each value with its sigma.
- `OrbitShape`: soft constraints of an almost circular orbit about the Earth's centre. At times :math:`t_k`:

  - in a plane through the Earth's centre: :math:`n \cdot S(t_k) = 0` with
    :math:`n = S(t_F) \times S(t_L) / |S(t_F) \times S(t_L)|`, first and last row;
  - circular: :math:`S \cdot \dot S / (|S| |\dot S|) = 0`;
  - at a flying height: :math:`|S| = R_s` in the middle of the scene.

Source: Willneff et al., section 3.3.2 (the first two); Weser et al. 2007 (tables as direct observations).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array, Constraints
from ortho_pipeline.models.pushbroom.splines import Spline

#: Position (or velocity: derivative 1) in ECEF ``(N, 3)`` at times ``(N,)``, and its partials ``(N, 3, P)``.
Path = Callable[[Array, int], tuple[Array, Array]]
#: Largest number of times for the shape of an orbit; one scene needs two.
MOST_SAMPLES = 1000


@dataclass(frozen=True, eq=False)
class Observations:
    """Known values of a spline, or of its derivative, at given times.

    Parameters
    ----------
    times : (k,)
        Seconds.
    values, sigma : (k, 3)
        In the unit of the spline (per second for a derivative).
    derivative : {0, 1}
        0: the value is observed; 1: its rate.
    fictitious : bool
        True if they are not measured; the sigma is then an assumption.
    """

    times: Array
    values: Array
    sigma: Array
    derivative: int = 0
    fictitious: bool = False

    def __post_init__(self) -> None:
        times = np.array(self.times, dtype=np.float64)
        values, sigma = (np.array(value, dtype=np.float64) for value in (self.values, self.sigma))
        if times.ndim != 1 or values.shape != (len(times), 3) or sigma.shape != values.shape:
            raise InputError("observations need k times, and k x 3 values and sigmas", field="observations")
        if not (np.isfinite(times).all() and np.isfinite(values).all() and np.isfinite(sigma).all()):
            raise InputError("an observation is not finite", field="observations")
        if not (sigma > 0).all() or self.derivative not in (0, 1):
            raise InputError("sigmas must be positive, and values or rates must be observed", field="observations")
        if not isinstance(self.fictitious, bool):
            raise InputError(f"fictitious must be true or false, not {self.fictitious!r}", field="fictitious")
        for name, value in (("times", times), ("values", values), ("sigma", sigma)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def of(self, spline: Spline, first: int, count: int) -> Constraints:
        """Return the pseudo-observations of a spline; its coefficients start at parameter `first` of `count`."""
        jacobian = np.zeros((len(self.times), 3, count))
        basis = spline.basis(self.times, self.derivative)
        for axis in range(3):
            jacobian[:, axis, first + axis : first + 3 * spline.size : 3] = basis
        residuals = self.values - spline(self.times, self.derivative)
        fictitious = np.full(residuals.size, self.fictitious)
        return Constraints(residuals.ravel(), jacobian.reshape(-1, count), self.sigma.ravel(), fictitious)

    def to_dict(self) -> dict[str, Any]:
        """Return the observations as plain data."""
        arrays = {name: getattr(self, name).tolist() for name in ("times", "values", "sigma")}
        return {**arrays, "derivative": self.derivative, "fictitious": self.fictitious}


@dataclass(frozen=True)
class OrbitShape:
    """Soft constraints of a path: fictitious observations. None skips a constraint.

    Parameters
    ----------
    plane : float, optional
        Sigma (m) of the distance from the plane through the Earth's centre and both ends.
    circular : float, optional
        Sigma (rad) of the deviation from a right angle between position and velocity.
    radius, radius_sigma : float, optional
        Distance (m) from the Earth's centre in the middle of the scene, and its sigma.
    samples : int
        Number of times at which plane and circle are observed.
    """

    plane: float | None = None
    circular: float | None = None
    radius: float | None = None
    radius_sigma: float | None = None
    samples: int = 2

    def __post_init__(self) -> None:
        numbers = [value for value in (self.plane, self.circular, self.radius, self.radius_sigma) if value is not None]
        if not all(np.isfinite(value) and value > 0 for value in numbers):
            raise InputError("sigmas of soft constraints must be positive", field="shape")
        if not (isinstance(self.samples, int) and 1 <= self.samples <= MOST_SAMPLES):
            raise InputError(
                f"the number of samples must be 1 to {MOST_SAMPLES}, not {self.samples!r}", field="samples"
            )
        if (self.radius is None) != (self.radius_sigma is None):
            raise InputError("a radius needs its sigma", field="radius_sigma")

    def of(self, path: Path, span: tuple[float, float]) -> Constraints:
        """Return the pseudo-observations of a path between the times of its first and last row."""
        first, last = span
        inner = first + (last - first) * (np.arange(self.samples) + 0.5) / self.samples
        rows = []
        if self.plane is not None:
            rows.append(_plane(path, np.array([first, *inner, last]), self.plane))
        if self.circular is not None:
            rows.append(_circular(path, inner, self.circular))
        if self.radius is not None and self.radius_sigma is not None:
            place, slopes = path(np.array([(first + last) / 2]), 0)
            length = np.linalg.norm(place, axis=1)
            by = np.einsum("ni,nip->np", place / length[:, None], slopes)
            rows.append(Constraints(self.radius - length, by, np.full(1, self.radius_sigma)))
        soft = joined(rows, path(np.array([first]), 0)[1].shape[2])
        return replace(soft, fictitious=np.ones(len(soft), dtype=bool))

    def to_dict(self) -> dict[str, Any]:
        """Return the constraints as plain data."""
        return asdict(self)


def joined(parts: Sequence[Constraints], count: int) -> Constraints:
    """Return the pseudo-observations of all parts together, for `count` parameters."""
    return Constraints(
        np.concatenate([np.zeros(0), *(part.residuals for part in parts)]),
        np.concatenate([np.zeros((0, count)), *(part.jacobian for part in parts)]),
        np.concatenate([np.zeros(0), *(part.sigma for part in parts)]),
        np.concatenate([np.zeros(0, dtype=bool), *(part.fictitious for part in parts)]),
    )


def _plane(path: Path, times: Array, sigma: float) -> Constraints:
    place, slopes = path(times, 0)
    ends = place[[0, -1]]
    # The difference of the ends keeps rounding errors at a nanometre.
    normal = np.cross(ends[0], ends[1] - ends[0])
    normal /= np.linalg.norm(normal)
    # n is always normal to both ends, so the plane at a S_F + b S_L moves with them.
    shares = np.linalg.lstsq(ends.T, place[1:-1].T, rcond=None)[0]
    by = np.einsum("i,nip->np", normal, slopes)
    return Constraints(
        -((place[1:-1] - ends[0]) @ normal), by[1:-1] - shares.T @ by[[0, -1]], np.full(len(times) - 2, sigma)
    )


def _circular(path: Path, times: Array, sigma: float) -> Constraints:
    (place, by_place), (rate, by_rate) = path(times, 0), path(times, 1)
    far, fast = (np.linalg.norm(vector, axis=1)[:, None] for vector in (place, rate))
    up, along = place / far, rate / fast
    cosine = (up * along).sum(axis=1)
    by = np.einsum("ni,nip->np", (along - cosine[:, None] * up) / far, by_place)
    by += np.einsum("ni,nip->np", (up - cosine[:, None] * along) / fast, by_rate)
    return Constraints(-cosine, by, np.full(len(times), sigma))
