"""The extra that installs each package that the command line needs."""

#: Packages that the command line needs, always or only for some tasks, and the extra that installs each.
EXTRA_OF_PACKAGE = {
    "cv2": "server",
    "deflate": "server",
    "faiss": "server",
    "fastapi": "server",
    "google": "server",
    "grpc": "server",
    "grpc_health": "server",
    "grpc_reflection": "server",
    "grpc_status": "server",
    "httptools": "server",
    "lz4": "server",
    "onnxruntime": "server",
    "prometheus_client": "server",
    "pydantic_settings": "server",
    "rich": "server",
    "typer": "server",
    "uvicorn": "server",
    "uvloop": "server",
    "rosbags": "ros",
    "laspy": "clouds",
    "plyfile": "clouds",
    "pypcd4": "clouds",
    "osmium": "geo",
    "pyproj": "geo",
    "gtsam": "mapping",
    "kiss_icp": "odometry",
    "small_gicp": "mapping",
    "carla": "carla",
    "ray": "ray",
    "cyclonedds": "ros2",
    "obstore": "store",
    "rerun": "view",
    "foxglove": "view",
}


def package_of(error: ModuleNotFoundError) -> str:
    """Return the top-level package that is missing.

    Args:
        error: of the import.
    """
    return (error.name or "").partition(".")[0]
