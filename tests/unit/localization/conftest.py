import numpy as np
import pytest

from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.localization.scoring import Candidate
from service.registration.register import Registered
from service.registration.rendered import Agreement


@pytest.fixture(scope="session")
def candidate():
    """Make a registered pose of some support."""

    def made(support=0.0, *, xyz=(0.0, 0.0, 1.5), heading_deg=0.0, scale=1.0):
        R = rotation_z(np.deg2rad(heading_deg))
        registered = Registered(R, np.array(xyz, np.float64), scale, 0.0, 0.7, np.eye(8), 0)
        T_map_camera = transform_from(R @ R_BODY_OPTICAL, np.array(xyz, np.float64))
        return Candidate(T_map_camera, registered, 0.8, 1.5, Agreement(-1.5, 0.02, 0.2, 0.1), support)

    return made
