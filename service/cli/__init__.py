"""The command line. Where the service cannot run it ends at once, before an import of something that is missing there fails."""

import sys

from service.errors import UnsupportedPlatformError
from service.platforms import require_supported

try:
    require_supported()
except UnsupportedPlatformError as error:
    sys.exit(f"streetfix: {error.message}")
