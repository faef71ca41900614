"""The command line. On an unsupported platform it exits at once, before an import of a missing package fails."""

import sys

from service.errors import UnsupportedPlatformError
from service.platforms import require_supported

try:
    require_supported()
except UnsupportedPlatformError as error:
    sys.exit(f"streetfix: {error.message}")
