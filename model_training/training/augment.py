"""Simulate the errors of sensors on clean views: noise, gaps, blocked parts, cut rows and columns.

Every pair gets new errors each time. All functions work on batches on the view grid.
The presets of the evaluation (``simulation.depth_noise``) act on whole images, with other code and other seeds.
Only the kinds of error are the same here. The ranges of the parameters are wider.
"""

from collections.abc import Sequence

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor
from torch.nn import functional

from service.imaging.fusion import IHS_FROM_RGB
from service.imaging.view_grid import BRIGHTNESS_FLOOR, BRIGHTNESS_LIMIT, LEAST_BRIGHTNESS_SPREAD, PLANES, ViewGrid
from service.registration.points import FOCAL_BASELINE_PX_M


class Augmentation(BaseModel):
    """Settings of the augmentation.

    Attributes:
        disparity_noise_px: least and greatest standard deviation of the disparity, pixels at 80 px m; drawn log-uniformly.
        scale_error: greatest relative error of the depth scale.
        monocular: probability per view that the scale has errors as large as those of monocular depth.
        monocular_scale_error: greatest relative error of such a scale.
        invented_depth: probability per view of a region with false depth where nothing was measured.
        short_range: probability per view that depth ends before the grid's greatest range.
        shortest_range_m: least such range, metres (z).
        no_colour: probability per view without colour planes.
        narrow_rows: probability per view of hidden rows at the top, and again at the bottom.
        narrow_columns: probability per view of hidden columns at both sides.
        blocked: probability per view of a vehicle that hides up to ``widest_block`` of the columns.
        widest_block: share of the columns.
        small_blocks: probability per view of a vehicle that hides 3 % to 20 % of the columns.
        unseen_top_rows: probability per view that the survey sensor misses the top 8 to 16 rows.
        survey_noise_m: standard deviation of LiDAR ranges, metres.
        survey_dropout: greatest share of LiDAR cells that are lost.
        no_intensity: probability per survey view without brightness.
        intensity_gain: strength of the smooth and the independent error of the LiDAR intensity, natural logarithm.
        no_brightness: probability per query view without brightness.
        shading: strength of the smooth and the independent error of the image's grey level, natural logarithm.
        height_error_m: standard deviation of the camera's height, metres.
        matched_noise_px: greatest standard deviation of further disparity noise where depth comes from stereo matching, pixels at 80 px m.
        matched_offset_px: standard deviation of a further disparity offset of such a view, pixels at 80 px m.
        matched_scale_error: standard deviation of the relative error of its depth scale.
        matched_unchanged: probability per view of neither noise nor offset.
        matched_holes: least and greatest threshold of a view, standard deviations. A smooth random field above it makes a hole.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    disparity_noise_px: tuple[float, float] = (0.02, 0.7)
    scale_error: float = 0.02
    monocular: float = 0.1
    monocular_scale_error: float = 0.12
    invented_depth: float = 0.2
    short_range: float = 0.25
    shortest_range_m: float = 8.0
    no_colour: float = 0.4
    narrow_rows: float = 0.2
    narrow_columns: float = 0.2
    blocked: float = 0.35
    widest_block: float = 0.4
    small_blocks: float = 0.3
    unseen_top_rows: float = 0.15
    survey_noise_m: float = 0.02
    survey_dropout: float = 0.05
    no_intensity: float = 0.2
    intensity_gain: float = 0.3
    no_brightness: float = 0.2
    shading: float = 0.3
    height_error_m: float = 0.08
    matched_noise_px: float = 0.25
    matched_offset_px: float = 0.075
    matched_scale_error: float = 0.01
    matched_unchanged: float = 0.3
    matched_holes: tuple[float, float] = (1.2, 2.4)


class Augmenter:
    """Draw errors for batches of views.

    All random numbers come from one generator.

    Args:
        settings: probabilities and sizes of the errors.
        grid: the view grid.
        generator: source of all random numbers; on ``device``.
        device: device of all tensors.
    """

    def __init__(
        self, settings: Augmentation, grid: ViewGrid, generator: torch.Generator, device: torch.device
    ) -> None:
        self.settings, self.grid, self._generator, self.device = settings, grid, generator, device
        self.elevation = torch.tensor(grid.elevations_rad, dtype=torch.float32, device=device)[:, None]
        self.azimuth = torch.tensor(grid.azimuths_rad.copy(), dtype=torch.float32, device=device)[None, :]
        # z along the optical axis per metre of range, for a level camera.
        self.z_of_range = torch.cos(self.elevation) * torch.cos(self.azimuth)
        # V1 and V2 of eq. 9, from the service.
        self.colour_of_rgb = torch.tensor(IHS_FROM_RGB[1:], dtype=torch.float32, device=device)

    def seed(self, numbers: Sequence[int]) -> None:
        """Start another sequence of random numbers.

        Args:
            numbers: non-negative numbers that the sequence depends on.
        """
        self._generator.manual_seed(int(np.random.SeedSequence(numbers).generate_state(1)[0]))

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self._generator, device=self.device)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator, device=self.device)

    def _chance(self, count: int, share: float) -> Tensor:
        return self._uniform(count, 1, 1) < share

    def _field(self, count: int, rows: int, columns: int) -> Tensor:
        coarse = self._normal(count, 1, rows, columns)
        size = (self.grid.rows, self.grid.columns)
        return functional.interpolate(coarse, size=size, mode="bilinear", align_corners=False)[:, 0]

    def cut_rows(self, rows_seen: Tensor, count: int) -> Tensor:
        """Return which rows the survey covers; in some views rows at the top are missing too.

        Args:
            rows_seen: rows that the LiDAR covers (rows).
            count: number of views, B.

        Returns:
            Boolean mask (B, rows, 1).
        """
        row = torch.arange(self.grid.rows, device=self.device)[None, :, None]
        top = (self._uniform(count, 1, 1) * 9 + 8).floor() * self._chance(count, self.settings.unseen_top_rows)
        return rows_seen.reshape(1, -1, 1) & (row >= top)

    def survey(self, ranges: Tensor, intensity: Tensor, height_m: Tensor, rows_seen: Tensor) -> Tensor:
        """Return the planes of LiDAR views with errors.

        Args:
            ranges: clean ranges (B, rows, columns), metres; 0 where nothing was measured.
            intensity: LiDAR intensity (B, rows, columns), 0..1.
            height_m: height of the LiDAR above the ground (B), metres.
            rows_seen: rows that the survey covers (B, rows, 1).

        Returns:
            Planes (B, 6, rows, columns) in the order of ``service.imaging.view_grid.PLANES``.
        """
        s, count = self.settings, len(ranges)
        noisy = ranges + self._normal(*ranges.shape) * s.survey_noise_m
        lost = self._uniform(*ranges.shape) < s.survey_dropout * self._uniform(count, 1, 1)
        keep = (ranges > 0) & ~lost & rows_seen & (noisy < self.grid.max_range_m)
        # Sensors compensate intensity for distance and angle in different ways. Some give no intensity at all.
        wrong = torch.exp(s.intensity_gain * (self._field(count, 3, 8) + 0.5 * self._normal(*ranges.shape)))
        known = ~self._chance(count, s.no_intensity)
        bright = brightness(intensity * wrong, measured=keep, seen=keep & known)
        return self._planes(torch.where(keep, noisy, 0.0), height_m, rows_seen.expand_as(ranges), None, bright)

    def query(
        self, ranges: Tensor, rgb: Tensor, height_m: Tensor, rows_seen: Tensor, *, seen: Tensor | None = None
    ) -> Tensor:
        """Return the planes of query views with errors.

        Args:
            ranges: ranges (B, rows, columns), metres; 0 where nothing was measured. They are clean unless ``seen`` is given.
            rgb: sRGB (B, 3, rows, columns), 0..255.
            height_m: height of the cameras above the ground (B), metres.
            rows_seen: rows that the survey covers (B, rows, 1).
            seen: cells that the camera looks at (B, rows, columns). Give it if the depth already has errors from stereo
                matching. Then only the small errors of ``matched_*`` are drawn.

        Returns:
            Planes (B, 6, rows, columns) in the order of ``service.imaging.view_grid.PLANES``.
        """
        s, count = self.settings, len(ranges)
        if seen is not None:
            ranges = self._matched_again(ranges)
        blocked = ranges
        blocked = self._block(blocked, height_m, self._chance(count, s.blocked), 0.12, s.widest_block)
        blocked = self._block(blocked, height_m, self._chance(count, s.small_blocks), 0.03, 0.2)
        z, measured = blocked * self.z_of_range, blocked > 0
        if seen is None:
            z, measured = self._stereo(z, measured)
        observed = rows_seen.expand_as(ranges) & self._field_of_view(count)
        if seen is not None:
            observed = observed & seen
        reach = torch.where(
            self._chance(count, s.short_range),
            s.shortest_range_m + (self.grid.max_range_m - s.shortest_range_m) * self._uniform(count, 1, 1),
            torch.full((count, 1, 1), self.grid.max_range_m, device=self.device),
        )
        distance = z / self.z_of_range
        keep = (
            measured & observed & (z < reach) & (distance < self.grid.max_range_m) & (distance > self.grid.min_range_m)
        )
        height = height_m + self._normal(count) * s.height_error_m
        light = torch.exp(s.shading * (self._field(count, 3, 6) + 0.3 * self._normal(*ranges.shape)))
        grey = (rgb.mean(dim=1) * light).clamp(max=255.0)
        # The vehicle in front has another brightness than the surface behind.
        hidden = blocked != ranges
        paint = (
            15.0 * torch.exp(2.6 * self._uniform(count, 1, 1)) * (1 + 0.1 * self._normal(*ranges.shape)).clamp(min=0.1)
        )
        grey = torch.where(hidden, paint.clamp(max=255.0), grey)
        known = ~self._chance(count, s.no_brightness)
        bright = brightness(grey, measured=keep, seen=observed & known)
        return self._planes(torch.where(keep, distance, 0.0), height, observed, self._colour(rgb), bright)

    def _stereo(self, z: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Add stereo errors: correlated noise, bleeding edges, false depth in gaps, holes and a scale error."""
        s, count = self.settings, len(z)
        largest = torch.where(self._chance(count, s.monocular), s.monocular_scale_error, s.scale_error)
        z = z * (1 + (self._uniform(count, 1, 1) * 2 - 1) * largest)
        low, high = (torch.log(torch.tensor(v)) for v in s.disparity_noise_px)
        sigma = torch.exp(low + (high - low) * self._uniform(count, 1, 1))
        rows, columns = self.grid.rows, self.grid.columns
        noise = (
            1.0 * self._field(count, 12, 40)
            + 0.5 * self._field(count, 4, 12)
            + 0.5 * self._normal(count, rows, columns)
        )
        disparity = FOCAL_BASELINE_PX_M / z.clamp(min=0.3) + sigma * noise
        far = 150.0
        seen = torch.where(measured, FOCAL_BASELINE_PX_M / disparity.clamp(min=0.5), torch.full_like(z, far))
        near = least_of_nine(seen)
        bleeding = self._field(count, 8, 32) > 1.2 - 1.2 * self._uniform(count, 1, 1)
        seen = torch.where(bleeding, near, seen)
        measured = (measured | bleeding) & (seen < 0.9 * far)
        made = self._chance(count, s.invented_depth).reshape(-1).nonzero()[:, 0]
        region = self._field(len(made), 4, 8) > 0.3
        made_up = 18.0 * torch.exp(0.4 * self._field(len(made), 2, 4))
        seen = seen.index_copy(0, made, torch.where(region & ~measured[made], made_up, seen[made]))
        measured = measured.index_copy(0, made, measured[made] | region)
        measured = measured & (self._field(count, 8, 24) < 2.2 - 1.6 * self._uniform(count, 1, 1))
        return seen, measured

    def _matched_again(self, ranges: Tensor) -> Tensor:
        """Add a little noise, an offset and holes to stereo-matched depth, so that the network cannot learn its views by heart."""
        s, count = self.settings, len(ranges)
        z = ranges * self.z_of_range
        sigma = s.matched_noise_px * self._uniform(count, 1, 1) ** 2
        noise = self._field(count, 4, 12) + 0.5 * self._field(count, 12, 40)
        shift = sigma * noise + s.matched_offset_px * self._normal(count, 1, 1)
        scale = 1 + s.matched_scale_error * self._normal(count, 1, 1)
        changed = self._uniform(count, 1, 1) >= s.matched_unchanged
        disparity = FOCAL_BASELINE_PX_M / z.clamp(min=0.3) * scale + shift * changed
        again = FOCAL_BASELINE_PX_M / disparity.clamp(min=0.5) / self.z_of_range
        low, high = s.matched_holes
        lost = self._field(count, 8, 24) > low + (high - low) * self._uniform(count, 1, 1)
        return torch.where((ranges > 0) & ~lost, again, torch.zeros_like(ranges))

    def _block(self, ranges: Tensor, height_m: Tensor, happens: Tensor, narrowest: float, widest: float) -> Tensor:
        """Add the side of a vehicle: an upright plane at 2.5 to 8.5 m, 1.3 to 4 m high, over a share of the columns."""
        rows = happens.reshape(-1).nonzero()[:, 0]
        count, behind = len(rows), ranges[rows]
        width = (narrowest + (widest - narrowest) * self._uniform(count, 1, 1)) * self.grid.columns
        left = self._uniform(count, 1, 1) * (self.grid.columns + 0.6 * width) - 0.6 * width
        column = torch.arange(self.grid.columns, device=self.device)[None, None, :]
        distance = 2.5 + 6.0 * self._uniform(count, 1, 1)
        facing = (self._uniform(count, 1, 1) - 0.5) * 1.6
        slant = torch.cos(self.azimuth - facing).clamp(min=0.25)
        plane = distance / (slant * torch.cos(self.elevation))
        top = 1.3 + 2.7 * self._uniform(count, 1, 1)
        height = height_m[rows].reshape(-1, 1, 1) + plane * torch.sin(self.elevation)
        hides = (column >= left) & (column < left + width) & (height < top) & (height > 0.25)
        hides = hides & ((behind <= 0) | (behind > plane))
        return ranges.index_copy(0, rows, torch.where(hides, plane, behind))

    def _field_of_view(self, count: int) -> Tensor:
        """Cells (B, rows, columns) that the camera sees: some cameras are narrower, some borders are cut."""
        s = self.settings
        row = torch.arange(self.grid.rows, device=self.device)[None, :, None]
        column = torch.arange(self.grid.columns, device=self.device)[None, None, :]
        top = self._chance(count, s.narrow_rows) * self._uniform(count, 1, 1) * 10
        bottom = self._chance(count, s.narrow_rows) * self._uniform(count, 1, 1) * 10
        narrow = self._chance(count, s.narrow_columns)
        one = self.grid.columns / 128
        both = narrow * self._uniform(count, 1, 1) * 14 * one
        left = both + narrow * self._uniform(count, 1, 1) * 12 * one
        right = both + narrow * self._uniform(count, 1, 1) * 12 * one
        return (row >= top) & (row < self.grid.rows - bottom) & (column >= left) & (column < self.grid.columns - right)

    def _colour(self, rgb: Tensor) -> Tensor:
        """V1 and V2 (B, 2, rows, columns) in grey levels (eq. 9), with errors of white balance and saturation, and noise.

        Many views get no colour: both planes are 0.
        """
        known = (self._uniform(len(rgb)) > self.settings.no_colour).nonzero()[:, 0]
        count = len(known)
        balance = 1 + 0.12 * self._normal(count, 3, 1, 1)
        planes = torch.einsum("kc,bchw->bkhw", self.colour_of_rgb, rgb[known] * balance)
        planes = (planes + 3.0 * self._normal(*planes.shape)) * torch.exp(0.4 * self._normal(count, 1, 1, 1))
        return torch.zeros(len(rgb), *planes.shape[1:], device=self.device).index_copy(0, known, planes)

    def _planes(
        self, ranges: Tensor, height_m: Tensor, observed: Tensor, colour: Tensor | None, bright: Tensor
    ) -> Tensor:
        heights = torch.where(ranges > 0, ranges * torch.sin(self.elevation) + height_m.reshape(-1, 1, 1), 0.0)
        planes = torch.zeros(len(ranges), len(PLANES), self.grid.rows, self.grid.columns, device=self.device)
        if colour is not None:
            planes[:, 1:3] = torch.where(observed[:, None], colour, 0.0)
        for plane, values in ((0, ranges), (3, heights), (4, observed), (5, bright)):
            planes[:, plane] = values
        return planes


def least_of_nine(values: Tensor) -> Tensor:
    """Return the minimum of each cell and its eight neighbours.

    Two passes of shifts take a fifth of the time of a pooling layer.

    Args:
        values: (B, rows, columns).
    """
    for axis in (1, 2):
        ahead, behind = values.narrow(axis, 1, values.shape[axis] - 1), values.narrow(axis, 0, values.shape[axis] - 1)
        least = values.clone()
        least.narrow(axis, 0, ahead.shape[axis]).copy_(torch.minimum(behind, ahead))
        later = least.narrow(axis, 1, behind.shape[axis])
        later.copy_(torch.minimum(later, behind))
        values = least
    return values


def brightness(values: Tensor, *, measured: Tensor, seen: Tensor) -> Tensor:
    """Return ``service.imaging.view_grid.brightness`` of a batch: standard deviations from the mean of each view.

    Args:
        values: grey level or intensity (B, rows, columns).
        measured: cells that define mean and standard deviation (B, rows, columns).
        seen: cells that get a value (B, rows, columns); the others become 0.

    Returns:
        Brightness (B, rows, columns), clamped to +-``BRIGHTNESS_LIMIT``; 0 in views with too little contrast.
    """
    weight = measured.to(values.dtype)
    count = weight.sum(dim=(1, 2), keepdim=True).clamp(min=1)

    def mean(of: Tensor) -> Tensor:
        return (of * weight).sum(dim=(1, 2), keepdim=True) / count

    level = mean(values)
    logarithm = torch.log(values / level.clamp(min=1e-9) + BRIGHTNESS_FLOOR)
    middle = mean(logarithm)
    spread = mean((logarithm - middle) ** 2).sqrt()
    is_known = seen & (level > 0) & (spread >= LEAST_BRIGHTNESS_SPREAD)
    return torch.where(
        is_known,
        ((logarithm - middle) / spread.clamp(min=1e-6)).clamp(-BRIGHTNESS_LIMIT, BRIGHTNESS_LIMIT),
        torch.zeros_like(values),
    )
