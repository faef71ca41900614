"""Check the names of ``STREETFIX_*`` variables: settings, variables of other programs, and mistakes."""

import difflib
import re
from collections.abc import Iterable, Mapping

from pydantic import BaseModel

from service.errors import RequestError

PREFIX = "STREETFIX_"
#: Path of the settings file, if no flag gives it.
CONFIG = "STREETFIX_CONFIG"
#: Prefix of the variables of clients. The service does not read them.
CLIENT_PREFIX = "STREETFIX_CLIENT_"
#: The API key of a client. The name differs by one letter from the setting that requires keys.
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

#: Variables that Kubernetes and Docker inject for a service whose name begins with ``streetfix``.
_LINK_NAME = re.compile(r"_SERVICE_(HOST|PORT(_\w+)?)|_PORT_\d+_(TCP|UDP|SCTP)(_(PROTO|PORT|ADDR))?")
_LINK_VALUE = re.compile(r"(tcp|udp|sctp)://")


def require_known(environment: Mapping[str, str], settings: type[BaseModel]) -> None:
    """Refuse unknown ``STREETFIX_*`` variables.

    Otherwise a service with a misspelt key or TLS setting would run without protection.

    Args:
        environment: of the process.
        settings: model with the known fields; nested names are joined by two underscores.

    Raises:
        RequestError: a variable is no setting; the message suggests the nearest name. Or Kubernetes injected the variable.
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
        listed = ", ".join(f"{name}{did_you_mean(name.upper(), known)}" for name in unknown)
        raise RequestError(
            f"unknown setting: {listed}; docs/serving.md lists the settings. Variables of other programs may begin "
            f"with {CLIENT_PREFIX}",
            field=unknown[0],
        )


def setting_names(settings: type[BaseModel], prefix: str = "") -> list[str]:
    """Return the dotted names of all fields and of nested models.

    Args:
        settings: the model.
        prefix: put before each name.
    """
    names = []
    for name, field in settings.model_fields.items():
        names.append(prefix + name)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            names += setting_names(field.annotation, f"{prefix}{name}.")
    return names


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Suggest the nearest name: a space and the name in brackets; empty if no name is near.

    Args:
        name: unknown name.
        known: valid names.
    """
    near = difflib.get_close_matches(name, list(known), 1, 0.6)
    return f" (did you mean {near[0]}?)" if near else ""


def _shown(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
