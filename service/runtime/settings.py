"""Settings of a service.

Later sources override earlier ones: defaults, TOML file, environment ``STREETFIX_*``, flags. The command line loads them once.
"""

import os
import re
import tomllib
from collections.abc import Callable, Iterable
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_core import core_schema
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from service.errors import BundleError, RequestError
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.maps.search_address import COLLECTION, QUERY_S, checked_name, checked_search_url
from service.maps.store.remote import checked_url, is_url, split_version
from service.maps.tiles import OPEN_BYTES
from service.option_limits import FALSE_ACCEPT_RATE, LEAST_FALSE_ACCEPT_RATE
from service.retrieval.encoder import Provider
from service.runtime.environment import CLIENT_KEY, CONFIG, did_you_mean, require_known, setting_names
from service.runtime.readable import why_unreadable
from service.runtime.seal import LEAST_KEY

_LABEL = r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?"
#: A map in a list with colons: a URL, whose credentials are refused later, or a path.
_MAP_PATTERN = re.compile(r"\w+://(?:[^/@]*@)?[^:]*|[^:]+")
_HOST_PATTERN = re.compile(rf"\*|(\*\.)?{_LABEL}(\.{_LABEL})*")


#: Settings whose values a message must not show.
_NOT_SHOWN = ("qdrant_url", "qdrant_api_key")


class MapUrl(str):
    """URL of a map in object storage, such as ``s3://bucket/maps/town``, or ``s3://bucket/maps/town@VERSION`` for one version.

    Raises:
        ValueError: the URL is not valid.
    """

    __slots__ = ()

    def __new__(cls, text: str) -> "MapUrl":
        """Check the URL."""
        try:
            split_version(text)
            return super().__new__(cls, checked_url(text))
        except BundleError as error:  # pydantic reports it with the name of the setting
            raise ValueError(error.message) from error

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: object, _handler: object) -> core_schema.CoreSchema:
        """Accept only instances; ``Settings`` makes them from texts."""
        return core_schema.is_instance_schema(cls, serialization=core_schema.to_string_ser_schema())


class Limits(BaseModel):
    """Limits of one request, checked before memory is allocated."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    # gRPC stores the length of a message in 32 bits.
    max_request_bytes: int = Field(40 * 2**20, ge=1024, le=2**31 - 1, description="whole body of a request")
    max_message_bytes: int = Field(
        16 * 2**20,
        ge=1024,
        le=2**31 - 1,
        description="one gRPC message, no more than max_request_bytes; memory is kept for this size while a message is read",
    )
    max_part_bytes: int = Field(DEFAULT_LIMITS.max_bytes, ge=1024, le=2**31 - 1, description="one image, encoded")
    max_pixels: int = Field(DEFAULT_LIMITS.max_pixels, ge=1, le=2**30, description="one image, decoded")

    @property
    def message_bytes(self) -> int:
        """Size of the largest gRPC message: the lower of both limits, in bytes."""
        return min(self.max_message_bytes, self.max_request_bytes)


class Settings(BaseSettings):
    """All settings of the service. Nested names are joined by two underscores: ``STREETFIX_LIMITS__MAX_PIXELS``."""

    model_config = SettingsConfigDict(
        env_prefix="STREETFIX_", env_nested_delimiter="__", frozen=True, extra="forbid", cli_parse_args=False
    )

    maps: Annotated[tuple[Path | MapUrl, ...], NoDecode] = Field(
        (),
        description="map bundles, folders of them, or URLs of maps in object storage (URL@VERSION for one version), separated by ':'",
    )
    tile_cache: Path | None = Field(
        None,
        description="folder for maps from object storage, which processes may share; default: streetfix/tiles in ~/.cache",
    )
    tile_cache_bytes: int = Field(
        20_000_000_000,
        ge=1_000_000,
        le=2**60,
        description="bound of the tiles in tile_cache; the least recently used ones are deleted",
    )
    open_tile_bytes: int = Field(
        OPEN_BYTES,
        ge=1_000_000,
        le=2**60,
        description="bound of the tiles that a worker has open of each version of a tiled map; the least recently used ones are closed",
    )
    qdrant_url: str | None = Field(
        None,
        description="server of Qdrant that chooses the tiles of tiled maps, as http://127.0.0.1:6333; needs the extra qdrant. By default "
        "the search index of the map chooses them",
    )
    qdrant_collection: str = Field(COLLECTION, description="collection of this server (streetfix map index)")
    qdrant_api_key: SecretStr | None = Field(None, description="key of this server")
    qdrant_timeout_s: float = Field(
        QUERY_S, gt=0, le=60, description="seconds for the answer of this server to a query; a later one gets 503"
    )
    strict: bool = Field(
        False,
        description="do not start if any bundle cannot be mounted, or if there is none; by default, serve the others",
    )
    host: str = Field(
        "127.0.0.1", description="address to listen on; beyond loopback only with keys or client certificates"
    )
    port: int = Field(8000, ge=0, le=65535, description="0 lets the system choose")
    grpc_port: int | None = Field(
        None, ge=0, le=65535, description="gRPC beside REST, on the same host; default: not served"
    )
    allowed_hosts: Annotated[tuple[str, ...], NoDecode] = Field(
        (),
        description="host names that clients use, separated by ','; '*.example.org': all names below, '*': any",
    )
    health_port: int | None = Field(
        None,
        ge=0,
        le=65535,
        description="port for /livez and /readyz alone, always without TLS and keys; default: not served",
    )
    health_host: str | None = Field(None, description="address of the health port; default: that of host")
    health_metrics: bool = Field(
        False, description="serve /metrics on the health port too, to everybody who can reach it"
    )
    api_keys: Path | None = Field(
        None, description="file of API keys (streetfix keys); with it every request needs one"
    )
    tls_certificate: Path | None = Field(None, description="PEM chain; REST and gRPC accept only TLS")
    tls_key: Path | None = Field(None, description="PEM private key of the certificate")
    tls_client_ca: Path | None = Field(
        None, description="PEM authorities; clients need a certificate from them (mutual TLS)"
    )
    insecure_public: bool = Field(False, description="listen beyond loopback without keys or client certificates")
    watch_s: float = Field(
        10.0,
        ge=0,
        le=86400,
        description="seconds between two checks for new bundles, keys and certificates; 0: only on SIGHUP",
    )
    log_style: Literal["text", "json"] = Field("text", description="format of the log on stderr")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "warning", description="info: a line for each request"
    )
    traces_endpoint: str | None = Field(
        None, description="OpenTelemetry collector, as http://127.0.0.1:4318/v1/traces; needs the extra otel"
    )
    traces_share: float = Field(
        0.05, ge=0, le=1, description="share of requests without a trace context that the service traces"
    )
    grpc_streams: int = Field(32, ge=0, le=1000, description="gRPC streams that may be open at once")
    grpc_idle_s: float = Field(
        300.0, gt=0, le=86400, description="the service ends a stream that sends no frame for this many seconds"
    )
    drain_s: float = Field(
        0.0, ge=0, le=600, description="seconds after SIGTERM in which /readyz fails but requests are still answered"
    )
    grace_s: float = Field(20.0, ge=0, le=3600, description="seconds after the drain in which running requests may end")
    workers: int = Field(
        1, ge=1, le=64, description="processes that answer on the same ports; maps are in memory once for all of them"
    )
    threads: int | None = Field(
        None,
        ge=1,
        le=256,
        description="requests that a process works on at once; default: its share of the usable cores",
    )
    provider: Provider = Field(
        "cpu", description="execution provider of ONNX Runtime that runs the encoder; it must be installed"
    )
    queue: int = Field(64, ge=0, le=100_000, description="requests that may wait in a process; the next gets 503")
    request_memory_mib: int | None = Field(
        None,
        ge=1,
        le=2**24,
        description="memory for the requests of all processes together; default: computed from the container's limit",
    )
    request_timeout_s: float = Field(
        30.0, gt=0, le=86400, description="seconds from a request's first byte to its answer"
    )
    false_accept_rate: float = Field(
        FALSE_ACCEPT_RATE,
        ge=LEAST_FALSE_ACCEPT_RATE,
        lt=1,
        description="largest share of the out-of-map calibration queries that may be LOCALIZED. A higher rate than the default also "
        "accepts a confidence of 0.5 to 0.9",
    )
    belief_key: SecretStr | None = Field(
        None,
        min_length=LEAST_KEY,
        description=f"secret of {LEAST_KEY} characters or more that seals the belief which clients carry between requests; the same in "
        "all replicas. By default the service draws one, and a belief ends with the service",
    )
    console: bool = Field(True, description="serve the browser console at /console, and its endpoints")
    samples: Path | None = Field(
        None,
        description="folder of sample pairs for the console: NAME/rgb.*, depth.*, request.json, truth.json",
    )
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _safe(self) -> "Settings":
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together; set both or neither")
        if self.tls_client_ca is not None and self.tls_certificate is None:
            raise ValueError("tls_client_ca needs tls_certificate and tls_key")
        guarded = self.api_keys is not None or self.tls_client_ca is not None
        if not (guarded or self.insecure_public or is_loopback(self.host)):
            raise ValueError(
                f"host {self.host} can be reached from other machines without a key; set STREETFIX_API_KEYS to the "
                "file of `streetfix keys`, or STREETFIX_TLS_CLIENT_CA. If a proxy or firewall protects the service, set "
                "STREETFIX_INSECURE_PUBLIC=true"
            )
        return self

    @field_validator("belief_key", "qdrant_url", "qdrant_api_key", mode="before")
    @classmethod
    def _none_if_empty(cls, value: object) -> object:
        return value or None

    @field_validator("qdrant_url")
    @classmethod
    def _search_url(cls, value: str | None) -> str | None:
        return None if value is None else _valid(checked_search_url, value)

    @field_validator("qdrant_collection")
    @classmethod
    def _collection(cls, value: str) -> str:
        return _valid(checked_name, value)

    @field_validator("maps", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        given = _MAP_PATTERN.findall(value) if isinstance(value, str) else value
        if not isinstance(given, Iterable):
            return given
        return tuple(MapUrl(each) if isinstance(each, str) and is_url(each) else each for each in given if each)

    @field_validator("maps")
    @classmethod
    def _one_version_each(cls, value: tuple[Path | MapUrl, ...]) -> tuple[Path | MapUrl, ...]:
        urls = {each for each in value if isinstance(each, MapUrl)}
        maps = [split_version(each)[0] for each in urls]
        if twice := [each for each in maps if maps.count(each) > 1]:
            raise ValueError(f"{twice[0]} is given with two versions; give one of them, or only the URL")
        return value

    @field_validator("allowed_hosts", mode="before")
    @classmethod
    def _split_hosts(cls, value: object) -> object:
        return tuple(part.strip() for part in value.split(",") if part.strip()) if isinstance(value, str) else value

    @field_validator("allowed_hosts")
    @classmethod
    def _host_patterns(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(_host_pattern(each) for each in value)


def _valid(check: Callable[[str], str], value: str) -> str:
    try:
        return check(value)
    except RequestError as error:  # pydantic reports it with the name of the setting
        raise ValueError(error.message) from error


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address.

    Args:
        host: name or IP address. Names other than ``localhost`` do not count as loopback.
    """
    address = _address(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _host_pattern(value: str) -> str:
    """Return a host pattern in lower case: a name, ``*.name`` or ``*``. An IP address passes too; addresses are always allowed.

    Raises:
        ValueError: the value has a scheme, a port or a path, or is not a host name.
    """
    value = value.lower().rstrip(".")
    if _HOST_PATTERN.fullmatch(value) or _address(value.strip("[]")) is not None:
        return value
    raise ValueError(
        f"{value!r} is not a valid host name; write names without scheme and port, as maps.example.org or *.example.org"
    )


def _address(text: str) -> IPv4Address | IPv6Address | None:
    try:
        return ip_address(text)
    except ValueError:  # a name, which may resolve to any address
        return None


def load_settings(config: Path | None = None, **flags: object) -> Settings:
    """Load the settings: the environment overrides the file, and flags override both.

    Args:
        config: TOML file; None takes the file that ``STREETFIX_CONFIG`` names, if any.
        flags: values by the name of the setting; None means not given.

    Raises:
        RequestError: the file cannot be read, or a value is invalid; or a variable ``STREETFIX_*`` or a line of the file is
            unknown. The message names it.
    """
    require_known(os.environ, Settings)
    given: dict[str, Any] = {name: value for name, value in flags.items() if value is not None}
    named = config or (Path(os.environ[CONFIG]) if os.environ.get(CONFIG) else None)
    try:
        settings = Settings.model_validate(_with_file(named)(**given).model_dump())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            what = f"setting {where}: there is no such setting{did_you_mean(where, setting_names(Settings))}; docs/serving.md lists them"
        elif where in _NOT_SHOWN or first["loc"][:1] == ("maps",):  # nor the credentials of a URL
            what = f"setting {first['loc'][0]}: {first['msg'].removeprefix('Value error, ')}"
        elif where == "belief_key":  # a message must not show a secret
            what = f"setting belief_key: the value is not valid; give {LEAST_KEY} random characters or more, or leave it out"
        elif where:
            what = f"setting {where}: {first['msg']} (it is {first['input']!r})"
        else:
            what = f"settings: {first['msg'].removeprefix('Value error, ')}"
        raise RequestError(what, field=where) from error
    except PermissionError as error:
        raise RequestError(
            f"settings file {named}: {why_unreadable(Path(str(named)), error)}", field="config"
        ) from error
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise RequestError(
            f"settings file {named}: {error}; write TOML such as  port = 8000", field="config"
        ) from error
    if CLIENT_KEY in os.environ and settings.api_keys is None:
        raise RequestError(
            f"{CLIENT_KEY} is the key of a client, but the service has no keys; set {CLIENT_KEY}S to the file of keys "
            f"(streetfix keys), or unset {CLIENT_KEY}",
            field="api_keys",
        )
    return settings


def _with_file(path: Path | None) -> type[Settings]:
    if path is None:
        return Settings
    file = path

    class FromFile(Settings):
        """Settings with the file as the lowest source above the defaults."""

        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003
            file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            """Return the sources, the strongest first."""
            with file.open("rb"):  # pydantic-settings would ignore a missing file silently
                return init_settings, env_settings, TomlConfigSettingsSource(settings_cls, file)

    return FromFile
