"""Folders that hold compiled code: code runs only from places that nobody else could fill."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

from platformdirs import user_cache_path

from ..errors import CompilationError

# Links that one path may pass; more are a circle.
_MOST_LINKS = 40
# A link is not followed, and a pipe does not wait for its writer.
_READING = os.O_RDONLY | sum(
    getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY")
)


def cache_directory() -> Path:
    """Where compiled libraries are kept: ``$QPMHE_CACHE_DIR``, else the user's cache folder."""
    named = os.environ.get("QPMHE_CACHE_DIR")
    return Path(named).absolute() if named else user_cache_path("qpmhe")


def cache_folders() -> list[Path]:
    """The folders from which libraries are loaded, the one that takes new ones first.

    The temporary folder takes the place of a cache that is refused or cannot be written; it is not
    searched otherwise.
    """
    cache = cache_directory()
    found = [] if refusal(cache) or not os.access(cache, os.R_OK | os.X_OK) else [cache]
    if found and os.access(cache, os.W_OK):
        return found
    spare = _spare()
    if not refusal(spare, private=True) and os.access(spare, os.R_OK | os.W_OK | os.X_OK):
        found.insert(0, spare)
    return found


def writable_folder() -> Path:
    """The folder for new libraries, made where it is missing; raises `CompilationError`."""
    reasons = []
    for folder, private in ((cache_directory(), False), (_spare(), True)):
        try:
            folder.mkdir(mode=0o700, parents=not private, exist_ok=True)
        except OSError as error:
            reasons.append(f"{folder} cannot be made ({error.strerror})")
            continue
        reason = refusal(folder, private)
        if not reason and not os.access(folder, os.W_OK):
            reason = f"{folder} cannot be written"
        if not reason:
            return folder
        reasons.append(reason)
    raise CompilationError(
        f"there is no folder for compiled code: {'; '.join(reasons)}; set QPMHE_CACHE_DIR to a "
        "folder that you own and that nobody else can write."
    )


def refusal(folder: Path, private: bool = False) -> str:
    """Why code in a folder may be somebody else's; empty if nobody else can have put it there.

    The folder must be ours, and nobody else may be able to write it. The same holds for every
    folder and link on the way to it, which may also be the system's: who can write one of these
    can put another folder in its place. In a sticky folder, as ``/tmp`` is, others cannot replace
    our entries. With `private`, nobody else may read the folder either. A folder that is missing
    is not refused. Systems without POSIX owners have none to compare.
    """
    user = _user()
    if user is None:
        return ""
    place, rest, links = Path(folder.anchor), list(folder.parts[1:]), 0
    try:
        while rest:
            where = os.lstat(place)
            sticky = bool(where.st_mode & stat.S_ISVTX)
            if where.st_uid not in (user, 0) or (_others_write(where) and not sticky):
                return f"{place}, on the way to {folder}, can be changed by others"
            name = rest.pop(0)
            if name == "..":
                place = place.parent
                continue
            entry = os.lstat(place / name)
            if stat.S_ISLNK(entry.st_mode):
                links += 1
                if entry.st_uid not in (user, 0) or links > _MOST_LINKS:
                    return f"{place / name}, on the way to {folder}, is somebody else's link"
                target = Path(os.readlink(place / name))
                rest[:0] = target.parts[1:] if target.is_absolute() else target.parts
                place = Path(target.anchor) if target.is_absolute() else place
            else:
                place /= name
        found = os.lstat(place)
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except OSError as error:
        return f"{folder} cannot be read ({error.strerror})"
    if not stat.S_ISDIR(found.st_mode):
        return f"{folder} is no folder"
    if found.st_uid != user:
        return f"{folder} belongs to another user"
    if _others_write(found) or (private and found.st_mode & 0o077):
        return f"{folder} is open to others (mode {stat.S_IMODE(found.st_mode):o})"
    return ""


def own_file(path: Path) -> bytes | None:
    """The content of a file that is ours, that nobody else can write and that is no link."""
    try:
        with open(os.open(path, _READING), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                return None
            if _user() not in (None, found.st_uid) or _others_write(found):
                return None
            return file.read()
    except OSError:
        return None


def _spare() -> Path:
    """The folder that takes the place of a cache which cannot be used."""
    return Path(tempfile.gettempdir(), f"qpmhe-{_user()}").absolute()


def _user() -> int | None:
    return os.geteuid() if hasattr(os, "geteuid") else None


def _others_write(found: os.stat_result) -> bool:
    """Whether others can write; a group of the user alone, as many systems make one, is none."""
    if _user() is None or not found.st_mode & 0o022:
        return False
    return bool(found.st_mode & stat.S_IWOTH) or not _is_own_group(found.st_gid, found.st_uid)


def _is_own_group(group: int, user: int) -> bool:
    import grp
    import pwd

    try:
        name, entry = pwd.getpwuid(user).pw_name, grp.getgrgid(group)
    except KeyError:
        return False
    return entry.gr_name == name and set(entry.gr_mem) <= {name}
