"""Registration of a query's points to a map cloud by other libraries, without an initial pose or from a retrieved pose.

- KISS-Matcher (Lim et al., ICRA 2025): Faster-PFH features, graph-theoretic pruning, graduated non-convexity.
- FPFH features and RANSAC (Rusu et al., ICRA 2009; Zhou et al., Open3D, 2018), then point-to-plane ICP.
- GICP (Koide, small_gicp, JOSS 2024) from a retrieved pose.
"""

from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import ExtraMissingError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Transform, transform_from

Points = Float64[NDArray[np.float64], "N 3"]

#: Voxel size of both clouds for features, metres. GICP uses half of it.
VOXEL_M = 0.5
#: Largest depth, metres. Beyond it, stereo errors reach metres.
REACH_M = 40.0
#: Largest distance of a correspondence, metres: for RANSAC inliers, and for GICP.
NEAR_M, FROM_PLACE_M = 1.0, 3.0
RANSAC_ROUNDS, RANSAC_CONFIDENCE = 1_000_000, 0.999


def points_of_depth(depth_m: NDArray[np.float32], camera: PinholeCamera) -> Points:
    """Back-project a depth image.

    Args:
        depth_m: z (H, W), metres, 0 for no measurement.
        camera: camera of the depth image.

    Returns:
        Points (N, 3) in the optical frame, metres.
    """
    near = (depth_m > 0) & (depth_m < REACH_M)
    points: Points = camera.rays_of_pixels()[near] * depth_m[near][:, None].astype(np.float64)
    return points


def thinned_to_voxels(points: Points, voxel_m: float) -> Points:
    """Return the mean of the points in each voxel.

    Args:
        points: points (N, 3), metres.
        voxel_m: size of a voxel, metres.
    """
    _, of, counts = np.unique(
        np.floor(points / voxel_m).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    sums = np.zeros((len(counts), 3))
    np.add.at(sums, of.ravel(), points)
    means: Points = sums / counts[:, None]
    return means


def by_kiss_matcher(points: Points, map_points: Points) -> Transform | None:
    """Estimate T_map_camera by KISS-Matcher without an initial pose; None if it finds no pose.

    Args:
        points: points of the query (N, 3), metres, optical frame.
        map_points: points of the map (M, 3), metres, map frame.

    Raises:
        ExtraMissingError: kiss-matcher is not installed.
    """
    package = _package("kiss_matcher", "kiss-matcher")
    matcher = package.KISSMatcher(package.KISSMatcherConfig(VOXEL_M))
    found = matcher.estimate(points.astype(np.float32), map_points.astype(np.float32))
    if not found.valid:
        return None
    return transform_from(np.asarray(found.rotation, np.float64), np.asarray(found.translation, np.float64))


class FpfhMap:
    """A map cloud with its FPFH features, computed once.

    Args:
        map_points: points of the map (M, 3), metres, map frame.

    Raises:
        ExtraMissingError: Open3D is not installed.
    """

    def __init__(self, map_points: Points) -> None:
        self._o3d = _package("open3d", "open3d")
        self._cloud, self._features = self._prepared(map_points)

    def locate(self, points: Points) -> Transform | None:
        """Estimate T_map_camera without an initial pose; None if no three matches agree.

        Args:
            points: points of the query (N, 3), metres, optical frame.
        """
        registration = self._o3d.pipelines.registration
        self._o3d.utility.random.seed(0)
        cloud, features = self._prepared(points)
        found = registration.registration_ransac_based_on_feature_matching(
            cloud,
            self._cloud,
            features,
            self._features,
            True,
            NEAR_M,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(NEAR_M),
            ],
            registration.RANSACConvergenceCriteria(RANSAC_ROUNDS, RANSAC_CONFIDENCE),
        )
        if found.fitness == 0:
            return None
        finer = registration.registration_icp(
            cloud, self._cloud, NEAR_M, found.transformation, registration.TransformationEstimationPointToPlane()
        )
        return np.array(finer.transformation)

    def _prepared(self, points: Points) -> tuple[Any, Any]:
        """Return the thinned cloud with normals, and its features; the radii follow Open3D's manual."""
        geometry = self._o3d.geometry
        cloud = geometry.PointCloud(self._o3d.utility.Vector3dVector(points)).voxel_down_sample(VOXEL_M)
        cloud.estimate_normals(geometry.KDTreeSearchParamHybrid(2 * VOXEL_M, 30))
        features = self._o3d.pipelines.registration.compute_fpfh_feature(
            cloud, geometry.KDTreeSearchParamHybrid(5 * VOXEL_M, 100)
        )
        return cloud, features


class GicpMap:
    """A map cloud prepared for GICP.

    Args:
        map_points: points of the map (M, 3), metres, map frame.

    Raises:
        ExtraMissingError: small_gicp is not installed.
    """

    def __init__(self, map_points: Points) -> None:
        self._package = _package("small_gicp", "small_gicp")
        self._cloud, self._tree = self._package.preprocess_points(
            map_points, downsampling_resolution=VOXEL_M / 2, num_threads=1
        )

    def locate(self, points: Points, T_map_camera: Transform) -> Transform:
        """Refine T_map_camera from an initial pose.

        Args:
            points: points of the query (N, 3), metres, optical frame.
            T_map_camera: initial pose (4, 4).
        """
        own, _ = self._package.preprocess_points(points, downsampling_resolution=VOXEL_M / 2, num_threads=1)
        found = self._package.align(
            self._cloud,
            own,
            self._tree,
            T_map_camera,
            registration_type="GICP",
            max_correspondence_distance=FROM_PLACE_M,
            num_threads=1,
        )
        return np.array(found.T_target_source)


def _package(module: str, wheel: str) -> Any:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:  # Open3D also fails to import if a system library is missing
        raise ExtraMissingError(f'{module} cannot be used: {error}; pip install "{wheel}"', field=module) from error
