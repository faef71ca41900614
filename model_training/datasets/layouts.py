"""Names in recordings' layouts that both who writes and who reads them must know."""

#: A file in a drive's folder of KITTI's raw layout: each scan was measured at one moment by a sensor whose angles are right, as a
#: simulated one's. KITTI's own drives have no such file.
SCANS_AT_REST = "scans_at_rest.txt"
