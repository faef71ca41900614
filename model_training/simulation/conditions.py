"""Weather and light, with the strengths and sources of their models.

Extinction coefficients (per metre, one way) at 905 nm:
- rain: 1.076 R^0.67 dB/km (Carbonneau and Wisely, SPIE 3532, 1998; ITU-R P.1814) with R = 25 mm/h;
- snow: 5.50 S^1.38 dB/km, dry (ITU-R P.1817) with S = 2 mm/h of water;
- fog: Koschmieder, 3.912 / visibility, visibility 50 m.

LiDAR returns from particles come mostly from near the sensor, where the pulse is strong. Their share grows with the extinction
(Goodin et al., Electronics 8(1), 2019; Heinzler et al., RA-L 5(2), 2020: most false returns within 10 m in fog and snow).

Light is relative to a clear day. Rain, snow and fog have sky light but no direct sun. Wet surfaces are darker (Lekner and Dorf,
Applied Optics 27(7), 1988). Fresh snow reflects 0.8 to 0.9 of visible light (Warren, Reviews of Geophysics 20(1), 1982).

Triangulated depth gets noisier and sparser in rain, fog and darkness (measured by Gruber et al., 3DV 2019). No publication gives the
sizes, so we chose ``disparity_noise`` and ``holes``. We also chose ``streaks``, ``glare`` and ``ambient``.
"""

from dataclasses import dataclass

import numpy as np

#: Conversion from dB/km to 1/m.
_PER_METRE = np.log(10) / 10 / 1000


@dataclass(frozen=True, slots=True)
class Condition:
    """Strengths of one condition; the defaults are a clear day.

    Attributes:
        name: name of the condition.
        extinction_per_m: extinction of air, one way, per metre.
        false_returns: share of LiDAR beams that a particle returns.
        false_reach_m: mean distance of these particles, metres.
        wet: wetness, 0 to 1. It darkens surfaces, for the LiDAR too.
        snow_cover: share of snow on horizontal surfaces.
        sun_elevation_deg: mean elevation of the sun above the horizon, degrees.
        sun_strength: direct sunlight, relative to a clear day; 0: no sun and no shadows.
        ambient: sky light, relative to a clear day.
        headlights: whether the vehicle's headlights are on.
        glare: strength of the glare around the sun.
        streaks: density of rain streaks or snow flakes in the image.
        disparity_noise: factor on the noise of the depth camera.
        holes: how much the share of missing depth patches rises.
    """

    name: str
    extinction_per_m: float = 0.0
    false_returns: float = 0.0
    false_reach_m: float = 4.0
    wet: float = 0.0
    snow_cover: float = 0.0
    sun_elevation_deg: float = 40.0
    sun_strength: float = 1.0
    ambient: float = 1.0
    headlights: bool = False
    glare: float = 0.0
    streaks: float = 0.0
    disparity_noise: float = 1.0
    holes: float = 0.0


#: All conditions by name.
CONDITIONS = {
    c.name: c
    for c in (
        Condition("clear"),
        # A clear day among tall houses and trees: shaded surfaces see little of the sky. With this ``ambient`` the errors of stereo
        # matching are like those of KITTI drive 0005 (decision 0138).
        Condition("hard_light", ambient=0.45),
        Condition(
            "rain",
            1.076 * 25**0.67 * _PER_METRE,
            0.024,
            4.0,
            wet=0.8,
            sun_strength=0.0,
            ambient=0.8,
            streaks=0.5,
            disparity_noise=1.4,
            holes=0.25,
        ),
        Condition(
            "snow",
            5.50 * 2**1.38 * _PER_METRE,
            0.08,
            6.0,
            snow_cover=0.7,
            sun_strength=0.0,
            ambient=0.9,
            streaks=1.0,
            disparity_noise=1.5,
            holes=0.35,
        ),
        Condition("fog", 3.912 / 50, 0.16, 5.0, sun_strength=0.0, ambient=0.9, disparity_noise=1.8, holes=0.3),
        # Real night light of 1 lux is 1/10,000 of a cloudy day. With a long exposure and the gain at its limit, an image is as dark
        # and noisy as one at 1/80 of daylight with a daytime exposure. We render the latter.
        Condition("night", sun_strength=0.0, ambient=0.012, headlights=True, disparity_noise=1.8, holes=0.5),
        Condition(
            "low_sun", sun_elevation_deg=6.0, sun_strength=1.3, ambient=0.7, glare=1.0, disparity_noise=1.2, holes=0.2
        ),
    )
}
