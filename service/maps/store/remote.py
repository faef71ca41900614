"""The objects below a URL, through ``obstore``. Errors name the URL of the object and the remedy, and no credential."""

import hashlib
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from urllib.parse import urlsplit

from service.errors import BundleError, extra_missing
from service.maps.manifest import FILE, FileEntry

if TYPE_CHECKING:
    from obstore import GetResult, ObjectMeta
    from obstore.store import ObjectStore

#: Schemes of the URLs of maps.
SCHEMES = ("s3", "gs", "az", "file")
#: Largest object that ``Remote.read`` returns: the manifest of a map of 500,000 tiles.
MOST_READ_BYTES = 256 * 2**20
#: Bytes of an object that are in memory at once.
_CHUNK = 4 * 2**20
#: Parts of one object that are uploaded at once, 5 MiB each.
_PARTS = 4
#: A request is sent again after errors of the transport and of the server, for at most this long.
_RETRIES = 6
_RETRY_FOR, _FIRST_PAUSE, _LONGEST_PAUSE = timedelta(seconds=30), timedelta(milliseconds=100), timedelta(seconds=5)
#: A whole object may take long, but the connection and each piece may not.
_CLIENT = {"connect_timeout": "5s", "read_timeout": "30s", "timeout": "6h"}
#: Environment variable of each scheme that allows an endpoint without TLS. Without it, obstore's error contains _NO_HTTP.
_ALLOW_HTTP = {"s3": "AWS_ALLOW_HTTP", "gs": "GOOGLE_ALLOW_HTTP", "az": "AZURE_ALLOW_HTTP"}
_NO_HTTP = "builder error"
#: Query of an address in an error. The signature of Azure is in there.
_QUERY = re.compile(r"\?\S*")
_STATUS = re.compile(r"status code: (\d{3}[^:\n]*)")
_VERSION = re.compile(r"[0-9a-f]{16}")
_CODE = re.compile(r"<Code>(\w{1,64})</Code>")


@dataclass(frozen=True, slots=True)
class Content:
    """What is below a URL, for messages.

    Attributes:
        name: with its article.
        remedy: how to put it there.
        field: setting or argument that has the URL.
    """

    name: str
    remedy: str
    field: str


MAP = Content("a map", "push the map (streetfix map push)", "maps")


@dataclass(frozen=True, slots=True)
class StoredFile:
    """An object of a store, as a list shows it.

    Attributes:
        name: path below the URL.
        size: bytes.
        modified_ns: time of the last change, nanoseconds since 1970.
        e_tag: mark that changes with the content; None if the store has none.
    """

    name: str
    size: int
    modified_ns: int
    e_tag: str | None


def is_url(text: str) -> bool:
    """Return whether a text is a URL, and not a path.

    Args:
        text: of a setting or of the command line.
    """
    return "://" in text


def checked_url(text: str, content: Content = MAP) -> str:
    """Return a URL of a store without a final slash.

    Args:
        text: the URL, such as ``s3://bucket/maps/town``.
        content: what is there, for messages.

    Raises:
        BundleError: another scheme, no bucket or path, or a URL with credentials, a query or a fragment. The message repeats none of
            these.
    """
    try:
        parts = urlsplit(text)
        if "@" in parts.netloc:
            raise _wrong_url(
                content, parts.scheme, "has credentials; give them in environment variables (docs/operate.md)"
            )
    except ValueError as error:
        raise _wrong_url(content, text.partition("://")[0], "is not valid; write s3://BUCKET/PATH") from error
    if parts.scheme not in SCHEMES:
        known = ", ".join(f"{each}://" for each in SCHEMES)
        raise _wrong_url(content, parts.scheme, f"has no scheme of a store; write one of {known}")
    if parts.query or parts.fragment:
        raise _wrong_url(content, parts.scheme, "has a '?' or '#'; write only bucket and path")
    if parts.scheme == "file" and (parts.netloc or not parts.path.strip("/")):
        raise _wrong_url(content, parts.scheme, "names no folder; write three slashes, as in file:///srv/maps/town")
    if parts.scheme != "file" and not parts.netloc:
        raise _wrong_url(content, parts.scheme, "names no bucket; write s3://BUCKET/PATH")
    return f"{parts.scheme}{text[len(parts.scheme) :]}".rstrip("/")


def split_version(text: str) -> tuple[str, str | None]:
    """Return the URL of a map as ``checked_url`` returns it, and the version that ``URL@VERSION`` names; None for the current version.

    Args:
        text: such as ``s3://bucket/maps/town`` or ``s3://bucket/maps/town@3f9c2a7be01d4586``.

    Raises:
        BundleError: the URL is not valid (``checked_url``), or what follows the ``@`` is no version.
    """
    url = checked_url(text)
    folder, slash, last = url.rpartition("/")
    name, is_pinned, version = last.partition("@")
    if not is_pinned:
        return url, None
    if not _VERSION.fullmatch(version):
        what = "has an '@' without a version behind it; write URL@VERSION with the 16 hexadecimal digits of a version, or no '@'"
        raise _wrong_url(MAP, _scheme_of(url), what)
    return checked_url(f"{folder}{slash}{name}"), version


def _scheme_of(url: str) -> str:
    return url.partition(":")[0]


def _wrong_url(content: Content, scheme: str, what: str) -> BundleError:
    return BundleError(f"the URL {scheme}://... of {content.name} {what}", field=content.field)


class Remote:
    """The objects below a URL. Threads may share it. A process must open its own one after ``fork``.

    Args:
        url: as ``checked_url`` returns it.
        store: opened for this URL.
        content: what is there, for messages.

    Attributes:
        url: as given.
    """

    def __init__(self, url: str, store: "ObjectStore", content: Content = MAP) -> None:
        self.url = url
        self._store, self._content = store, content

    @classmethod
    def open(cls, url: str, *, create: bool = False, content: Content = MAP) -> "Remote":
        """Open a store. Only for ``file://`` does this look at the store.

        Credentials, region and endpoint come from the environment, as obstore documents: ``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL``,
        ``GOOGLE_APPLICATION_CREDENTIALS``, ``AZURE_STORAGE_ACCOUNT_NAME`` and others.

        Args:
            url: URL of what is in the store.
            create: create the folder of a ``file://`` URL.
            content: what is there, for messages.

        Raises:
            BundleError: the URL or the configuration of the store is not valid, or the folder is missing.
            ExtraMissingError: obstore is not installed.
        """
        url = checked_url(url, content)
        try:
            from obstore.exceptions import BaseError
            from obstore.store import LocalStore, from_url
        except ModuleNotFoundError as error:
            raise extra_missing(f"{url}: {content.name} in object storage", "store", error) from error
        try:
            if url.startswith("file://"):
                return cls(url, LocalStore.from_url(url, mkdir=create), content)
            retry = {
                "max_retries": _RETRIES,
                "retry_timeout": _RETRY_FOR,
                "backoff": {"init_backoff": _FIRST_PAUSE, "max_backoff": _LONGEST_PAUSE, "base": 2},
            }
            # obstore reads this variable itself, but not beside other options of the client.
            allow_http = os.environ.get(_ALLOW_HTTP[_scheme_of(url)], "").lower() in ("1", "true")
            client = {**_CLIENT, "allow_http": allow_http}
            return cls(url, from_url(url, client_options=client, retry_config=retry), content)  # type: ignore[call-overload]
        except (BaseError, ValueError, OSError) as error:
            raise _failed(url, "cannot be opened", error) from error

    def read(self, name: str, *, unless: str | None = None) -> tuple[bytes, str | None] | None:
        """Read a small object.

        Args:
            name: path below the URL.
            unless: ETag of the content that the caller has; None reads in any case.

        Returns:
            The content and its ETag. None if the content still has the ETag ``unless``.

        Raises:
            BundleError: the object is missing, cannot be read, or is larger than ``MOST_READ_BYTES``.
        """
        from obstore.exceptions import NotModifiedError

        with self._naming_errors(name):
            try:
                found = self._store.get(name, options={"if_none_match": unless} if unless else None)
            except NotModifiedError:
                return None
            if found.meta["size"] > MOST_READ_BYTES:
                raise BundleError(
                    f"{self.url}/{name}: {found.meta['size']} bytes, more than {MOST_READ_BYTES}; {self._content.remedy}",
                    field=name,
                )
            return bytes(found.bytes()), found.meta["e_tag"]

    def read_if_there(self, name: str) -> bytes | None:
        """Read a small object; return None if it is missing.

        Args:
            name: path below the URL.

        Raises:
            BundleError: the object cannot be read.
        """
        try:
            found = self.read(name)
        except BundleError as error:
            if isinstance(error.__cause__, FileNotFoundError):
                return None
            raise
        return None if found is None else found[0]

    def save(self, name: str, entry: FileEntry, target: BinaryIO, *, on_bytes: Callable[[int], object]) -> None:
        """Stream an object into an open file, and check its size and hash.

        Args:
            name: path below the URL.
            entry: expected size and hash. Nothing is written if the store announces another size.
            target: open for writing.
            on_bytes: called with the number of bytes of each piece. It may raise to end the transfer.

        Raises:
            BundleError: the object is missing, cannot be read, or has another size or hash.
            OSError: the file cannot be written.
        """
        with self._naming_errors(name):
            try:
                found = self._store.get(name)
            except FileNotFoundError as error:
                raise self._damaged(name, "is missing in the store") from error
        if (size := found.meta["size"]) != entry.size:
            raise self._damaged(name, f"{size} bytes instead of {entry.size}")
        digest, read = hashlib.sha256(), 0
        for chunk in self._chunks(name, found):
            read += len(chunk)
            if read > entry.size:
                break
            digest.update(chunk)
            target.write(chunk)
            on_bytes(len(chunk))
        if read != entry.size:
            raise self._damaged(name, f"{read} bytes instead of {entry.size}")
        if digest.hexdigest() != entry.sha256:
            raise self._damaged(name, "the hash does not match the manifest")

    def files(self, folder: str) -> list[StoredFile]:
        """List the objects in a folder, without those of its subfolders, by name.

        Args:
            folder: path below the URL.

        Raises:
            BundleError: the store cannot be read.
        """
        with self._naming_errors(folder):
            found = [
                _listed(each)
                for chunk in self._store.list(folder)
                for each in chunk
                if each["path"].rpartition("/")[0] == folder
            ]
        return sorted(found, key=lambda file: file.name)

    def look(self, name: str) -> StoredFile | None:
        """Return an object without its content; None if it is missing.

        Args:
            name: path below the URL.

        Raises:
            BundleError: the store cannot be read.
        """
        with self._naming_errors(name):
            try:
                return _listed(self._store.head(name))
            except FileNotFoundError:
                return None

    def save_listed(self, file: StoredFile, target: BinaryIO, *, on_bytes: Callable[[int], object]) -> None:
        """Stream an object into an open file, if it is still the one of the list.

        Args:
            file: of ``files`` or ``look``.
            target: open for writing.
            on_bytes: called with the number of bytes of each piece. It may raise to end the transfer.

        Raises:
            BundleError: the object is missing, cannot be read, or has changed since it was listed.
            OSError: the file cannot be written.
        """
        from obstore.exceptions import PreconditionError

        changed = BundleError(
            f"{self.url}/{file.name} has changed since the command began; run it again", field=file.name
        )
        with self._naming_errors(file.name):
            try:
                found = self._store.get(file.name, options={"if_match": file.e_tag} if file.e_tag else None)
            except PreconditionError as error:
                raise changed from error
        if not _is_same(_listed(found.meta), file):
            raise changed
        read = 0
        for chunk in self._chunks(file.name, found):
            read += len(chunk)
            target.write(chunk)
            on_bytes(len(chunk))
        # An object in a bucket is replaced as a whole. A file may be written over while it is read.
        now = self.look(file.name) if _scheme_of(self.url) == "file" else file
        if read != file.size or now is None or not _is_same(now, file):
            raise changed

    def put(self, name: str, content: bytes | Path) -> None:
        """Store an object. Readers see the whole object or the one before.

        Args:
            name: path below the URL.
            content: the bytes, or the file that has them.

        Raises:
            BundleError: the object cannot be stored.
        """
        with self._naming_errors(name, "cannot be written"):
            self._store.put(name, content, max_concurrency=_PARTS)

    def _chunks(self, name: str, found: "GetResult") -> Iterator[bytes]:
        """Yield the content of an object piece by piece; errors name the object."""
        if _scheme_of(self.url) == "file":
            yield from self._chunks_of_file(name, found)
            return
        with self._naming_errors(name):
            chunks = iter(found.stream(min_chunk_size=_CHUNK))
        while True:
            with self._naming_errors(name):
                chunk = next(chunks, None)
            if chunk is None:
                return
            yield chunk

    def _chunks_of_file(self, name: str, found: "GetResult") -> Iterator[bytes]:
        """Yield the content of a local file. A stream of obstore would never end if the file became shorter meanwhile.

        Raises:
            BundleError: the file has changed since ``found``, or cannot be read.
        """
        size, e_tag = found.meta["size"], found.meta["e_tag"]
        for start in range(0, size, _CHUNK):
            with self._naming_errors(name):
                if self._store.head(name)["e_tag"] != e_tag:
                    raise BundleError(f"{self.url}/{name} has changed while it was read; try again", field=name)
                chunk = bytes(self._store.get_range(name, start=start, length=min(_CHUNK, size - start)))
            yield chunk

    def _damaged(self, name: str, what: str) -> BundleError:
        # Only without this manifest does ``push`` store the files again.
        beside = f"{name.rpartition('/cloud/')[0] or name.rpartition('/')[0]}/{FILE}".lstrip("/")
        return BundleError(
            f"{self.url}/{name}: {what}; delete {beside} in the store and push the map again (streetfix map push)",
            field=name,
        )

    @contextmanager
    def _naming_errors(self, name: str, what: str = "cannot be read") -> Iterator[None]:
        """Turn errors of the store inside the context into errors that name the object."""
        from obstore.exceptions import BaseError

        try:
            yield
        except FileNotFoundError as error:
            problem = "is missing in the store" if what == "cannot be read" else f"{what} (404: no such bucket)"
            remedy = f"check the URL, or {self._content.remedy}"
            raise BundleError(f"{self.url}/{name} {problem}; {remedy}", field=name) from error
        except (BaseError, OSError, ValueError) as error:
            raise _failed(f"{self.url}/{name}", what, error) from error


def _listed(meta: "ObjectMeta") -> StoredFile:
    return StoredFile(meta["path"], meta["size"], round(meta["last_modified"].timestamp() * 1e9), meta["e_tag"])


def _is_same(one: StoredFile, other: StoredFile) -> bool:
    """Return whether two lists show the same content: by size and ETag; by size and time, to the second, without an ETag."""
    if one.size != other.size:
        return False
    if one.e_tag and other.e_tag:  # some stores quote it in one answer only
        return one.e_tag.strip('"') == other.e_tag.strip('"')
    return abs(one.modified_ns - other.modified_ns) < 10**9


def _failed(url: str, what: str, error: Exception) -> BundleError:
    """Return the error for a failure of the store. Its text has no query, no body of an answer and no header."""
    whole = str(error)
    line = _QUERY.sub("", whole.partition("\n")[0])
    if (status := _STATUS.search(line)) is not None:
        code = _CODE.search(whole)
        line = f"status {status[1].strip()}" + (f", {code[1]}" if code else "")
    if _NO_HTTP in line and _scheme_of(url) in _ALLOW_HTTP:
        remedy = f"for an endpoint without TLS set {_ALLOW_HTTP[_scheme_of(url)]}=true"
    else:
        remedy = "check the URL, the endpoint, the network and the credentials (docs/operate.md)"
    return BundleError(f"{url} {what} ({line[:300]}); {remedy}", field=url.rpartition("/")[2])
