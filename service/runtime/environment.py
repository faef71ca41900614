"""Names of ``STREETFIX_*`` variables: which are settings, which belong to others, and which are mistakes."""

import difflib
import re
from collections.abc import Iterable, Mapping

from pydantic import BaseModel

from service.errors import RequestError

PREFIX = "STREETFIX_"
#: Names the settings file where no flag does.
CONFIG = "STREETFIX_CONFIG"
#: Variables of clients begin with this; the service does not read them.
CLIENT_PREFIX = "STREETFIX_CLIENT_"
#: What the clients read as their key. It is one letter away from the setting that asks for keys.
CLIENT_KEY = "STREETFIX_API_KEY"
#: Read by ``docker compose`` on the host, see deploy/compose.yaml and deploy/compose.tls.yaml.
COMPOSE = frozenset(
    {
        "STREETFIX_MAPS_FOLDER",
        "STREETFIX_KEYS_FILE",
        "STREETFIX_SCRAPE_KEY_FILE",
        "STREETFIX_PUBLISH_ADDRESS",
        "STREETFIX_CERTIFICATE_FILE",
        "STREETFIX_CERTIFICATE_KEY_FILE",
    }
)

#: What Kubernetes and Docker inject for a service whose name begins with ``streetfix``.
_LINK_NAME = re.compile(r"_SERVICE_(HOST|PORT(_\w+)?)|_PORT_\d+_(TCP|UDP|SCTP)(_(PROTO|PORT|ADDR))?")
_LINK_VALUE = re.compile(r"(tcp|udp|sctp)://")


def require_known(environment: Mapping[str, str], settings: type[BaseModel]) -> None:
    """Refuse variables of ours that nobody reads: a misspelt key or TLS setting would serve without protection.

    Args:
        environment: of the process.
        settings: whose fields are known, nested ones by two underscores.

    Raises:
        RequestError: a variable is no setting; the message has the nearest name.
    """
    known = {f"{PREFIX}{name.upper().replace('.', '__')}" for name in setting_names(settings)}
    links, unknown = [], []
    for name, value in sorted(environment.items()):
        upper = name.upper()
        if not upper.startswith(PREFIX):
            continue
        if _LINK_VALUE.match(value) or (upper not in known and _LINK_NAME.search(upper)):
            links.append(name)
        elif upper not in known | COMPOSE | {CONFIG, CLIENT_KEY} and not upper.startswith(CLIENT_PREFIX):
            unknown.append(name)
    if links:
        raise RequestError(
            f"the environment has {_shown(links)}, which Kubernetes injects for a Service called streetfix; set "
            "enableServiceLinks: false in the pod's specification (the Helm chart does), or rename the Service",
            field=links[0],
        )
    if unknown:
        told = ", ".join(f"{name}{did_you_mean(name.upper(), known)}" for name in unknown)
        raise RequestError(
            f"no setting of the service: {told}; docs/serving.md lists the settings. Variables of other programs may begin "
            f"with {CLIENT_PREFIX}",
            field=unknown[0],
        )


def setting_names(settings: type[BaseModel], prefix: str = "") -> list[str]:
    """Dotted names of all fields, and of the models that hold them."""
    names = []
    for name, field in settings.model_fields.items():
        names.append(prefix + name)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            names += setting_names(field.annotation, f"{prefix}{name}.")
    return names


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The nearest name in brackets, with a space before it; empty where none is near."""
    near = difflib.get_close_matches(name, list(known), 1, 0.6)
    return f" (did you mean {near[0]}?)" if near else ""


def _shown(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
