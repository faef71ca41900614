"""Weather and light, with the strengths and sources of their models.

Extinction coefficients (per metre, one way) at 905 nm:
- rain: 1.076 R^0.67 dB/km (Carbonneau and Wisely, SPIE 3532, 1998; ITU-R P.1814) with R = 25 mm/h;
- snow: 5.50 S^1.38 dB/km, dry (ITU-R P.1817) with S = 2 mm/h of water;
- fog: Koschmieder, 3.912 / visibility, visibility 50 m.
Particles that answer a LiDAR come near the sensor, where its pulse is strong; their share grows with the extinction
(Goodin et al., Electronics 8(1), 2019; Heinzler et al., RA-L 5(2), 2020: most false returns within 10 m in fog and snow).

Light, relative to a clear day's: rain, snow and fog have no sun of their own, the sky's light alone; wet surfaces are darker (Lekner and
Dorf, Applied Optics 27(7), 1988), fresh snow reflects 0.8 to 0.9 of what is visible (Warren, Reviews of Geophysics 20(1), 1982).
That triangulated depth gets noisier and sparser in rain, fog and darkness is measured (Gruber et al., 3DV 2019); by how much
(``disparity_noise``, ``holes``) is chosen here, and so are ``streaks``, ``glare`` and ``ambient``: no publication gives them.
"""

from dataclasses import dataclass

import numpy as np

_PER_METRE = np.log(10) / 10 / 1000  # dB/km to 1/m


@dataclass(frozen=True, slots=True)
class Condition:
    """Strengths of one condition; lengths in metres, angles in radians.

    ``false_returns`` is the share of LiDAR beams answered by a particle, ``false_reach_m`` their mean distance.
    ``disparity_noise`` multiplies the depth camera's noise, ``holes`` adds to its share of missing patches.
    """

    name: str
    extinction_per_m: float = 0.0
    false_returns: float = 0.0
    false_reach_m: float = 4.0
    wet: float = 0.0  # darkens surfaces, for the LiDAR too
    snow_cover: float = 0.0
    sun_elevation_deg: float = 40.0
    sun_strength: float = 1.0
    ambient: float = 1.0
    headlights: bool = False
    glare: float = 0.0
    streaks: float = 0.0
    disparity_noise: float = 1.0
    holes: float = 0.0


CONDITIONS = {
    c.name: c
    for c in (
        Condition("clear"),
        # A clear day among tall houses and trees: what the sun does not reach sees little of the sky. ``ambient`` is chosen so that
        # stereo matching errs as on KITTI's drive 0005 (decision log).
        Condition("hard_light", ambient=0.45),
        Condition("rain", 1.076 * 25**0.67 * _PER_METRE, 0.024, 4.0, wet=0.8, sun_strength=0.0, ambient=0.8, streaks=0.5,
                  disparity_noise=1.4, holes=0.25),
        Condition("snow", 5.50 * 2**1.38 * _PER_METRE, 0.08, 6.0, snow_cover=0.7, sun_strength=0.0, ambient=0.9, streaks=1.0,
                  disparity_noise=1.5, holes=0.35),
        Condition("fog", 3.912 / 50, 0.16, 5.0, sun_strength=0.0, ambient=0.9, disparity_noise=1.8, holes=0.3),
        # 1 lux is 1/10,000 of a cloudy day; with a long exposure and the gain at its limit a picture is as dark and noisy
        # as one of about 1/80 taken by day, which is what is drawn here.
        Condition("night", sun_strength=0.0, ambient=0.012, headlights=True, disparity_noise=1.8, holes=0.5),
        Condition("low_sun", sun_elevation_deg=6.0, sun_strength=1.3, ambient=0.7, glare=1.0, disparity_noise=1.2, holes=0.2),
    )
}  # fmt: skip
