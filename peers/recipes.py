"""How peers are installed: from npm, crates, Go modules, PyPI and Debian; versions are exact where a recipe can say it.

A recipe with a folder of its own marks it complete at the very end, with a fingerprint of what it was made from: a
folder that was left half done, or made from other versions, is made again.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from peers.running import InstallFailed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from peers.running import Runner

MANIFESTS = Path(__file__).parent
TESTS = MANIFESTS.parent / "tests"
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")


def cache_folder() -> Path:
    """Where peers are kept for all clones: `AIRA_PEERS_CACHE`, or `~/.cache/aira-mesh`. May be deleted at any time."""
    return Path(os.environ.get("AIRA_PEERS_CACHE") or "~/.cache/aira-mesh").expanduser()


class Recipe(Protocol):
    """One installation, which may give several peers."""

    @property
    def name(self) -> str:
        """What is installed, and in which version."""

    @property
    def environment(self) -> Mapping[str, str]:
        """What the installer finds in its environment, besides the caller's own."""

    def is_complete(self) -> bool:
        """Whether there is nothing to install, as far as the recipe itself can tell."""

    def install(self, run: Runner) -> None:
        """Install, or raise `InstallFailed`."""


@dataclass(frozen=True, kw_only=True)
class NpmRecipe:
    """The packages of `peers/npm/{manifest}/package.json`, by its lock file where it has one."""

    name: str
    manifest: str
    environment: Mapping[str, str] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        return cache_folder() / f"npm-{self.manifest}"

    def is_complete(self) -> bool:
        return _is_marked(self.folder, _fingerprint(self._files()))

    def install(self, run: Runner) -> None:
        files = self._files()
        _make_empty(self.folder)
        for file in files:
            shutil.copy(file, self.folder)
        locked = (self.folder / "package-lock.json").exists()
        run(["npm", "ci" if locked else "install", "--ignore-scripts"], timeout=900, cwd=self.folder)
        _mark(self.folder, _fingerprint(files))

    def _files(self) -> list[Path]:
        return sorted(file for file in (MANIFESTS / "npm" / self.manifest).iterdir() if file.is_file())


@dataclass(frozen=True, kw_only=True)
class PipRecipe:
    """A virtual environment of its own with the packages of `peers/pip/{manifest}.txt`."""

    name: str
    manifest: str
    environment: Mapping[str, str] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        return cache_folder() / f"pip-{self.manifest}"

    def is_complete(self) -> bool:
        """An environment whose Python has gone from the machine is a dangling link, and not complete."""
        return _is_marked(self.folder, _fingerprint([self._file()])) and (self.folder / "bin" / "python").exists()

    def install(self, run: Runner) -> None:
        _make_empty(self.folder)
        run([sys.executable, "-m", "venv", self.folder], timeout=120)
        pip = self.folder / "bin" / "pip"
        run([pip, "install", "--disable-pip-version-check", "--no-deps", "-r", self._file()], timeout=600)
        _mark(self.folder, _fingerprint([self._file()]))

    def _file(self) -> Path:
        return MANIFESTS / "pip" / f"{self.manifest}.txt"


COMPILING = {
    "CARGO_PROFILE_DEV_DEBUG": "false",
    "CARGO_PROFILE_DEV_DEBUG_ASSERTIONS": "false",
    "CARGO_PROFILE_DEV_INCREMENTAL": "false",
    "CARGO_PROFILE_DEV_OVERFLOW_CHECKS": "false",
}
"""What compiles fastest and behaves like a release: tests wait for messages, not for the processor."""


def build_folder() -> Path:
    """Where programs in Rust are compiled: what two of them need is compiled once, and kept for the next version."""
    return cache_folder() / "cargo"


@dataclass(frozen=True, kw_only=True)
class CargoRecipe:
    """One program built from crates: minutes on all cores, so it is rebuilt only for another version."""

    crate: str
    version: str
    environment: Mapping[str, str] = field(default_factory=lambda: COMPILING)

    @property
    def name(self) -> str:
        return f"{self.crate} {self.version}"

    @property
    def folder(self) -> Path:
        return cache_folder() / self.crate

    def is_complete(self) -> bool:
        """Cargo keeps a record of what it has installed under a root; it is written after the program."""
        record = self.folder / ".crates.toml"
        return record.exists() and f'"{self.crate} {self.version} ' in record.read_text()

    def install(self, run: Runner) -> None:
        into = ["--root", str(self.folder), "--target-dir", str(build_folder())]
        chosen = ["--version", self.version, self.crate]
        run(["cargo", "install", "--debug", "--locked", "--force", *into, *chosen], timeout=2400)


@dataclass(frozen=True, kw_only=True)
class SourceRecipe:
    """A program of this repository in Rust, built by its lock file: once with each set of features."""

    name: str
    source: Path
    programs: Mapping[str, str]
    """The names of the programs, each with the features that it is built with."""
    environment: Mapping[str, str] = field(default_factory=lambda: COMPILING)

    @property
    def folder(self) -> Path:
        return cache_folder() / self.name.split()[0]

    def is_complete(self) -> bool:
        return _is_marked(self.folder, _fingerprint(self._files()))

    def install(self, run: Runner) -> None:
        files = self._files()
        (self.folder / "bin").mkdir(parents=True, exist_ok=True)
        for program, features in self.programs.items():
            chosen = ["--no-default-features", "--features", features, "--target-dir", str(build_folder())]
            run(["cargo", "build", "--locked", *chosen], timeout=2400, cwd=self.source)
            shutil.copy(build_folder() / "debug" / self.name.split()[0], self.folder / "bin" / program)
        _mark(self.folder, _fingerprint(files))

    def _files(self) -> list[Path]:
        return [self.source / "Cargo.toml", self.source / "Cargo.lock", *sorted((self.source / "src").glob("*.rs"))]


@dataclass(frozen=True, kw_only=True)
class GoRecipe:
    """One program built from Go modules, for a minute or more on all cores.

    `package` is built at `version`; or, if `source` is given, the module in that folder. What the Go client downloads
    and compiles on the way, some gigabytes, is removed.
    """

    name: str
    program: str
    package: str = ""
    version: str = ""
    source: Path | None = None
    environment: Mapping[str, str] = field(default_factory=lambda: {"GOTOOLCHAIN": "auto", "GOFLAGS": "-modcacherw"})

    @property
    def folder(self) -> Path:
        return cache_folder() / f"go-{self.program}"

    def is_complete(self) -> bool:
        return _is_marked(self.folder, self.made_from())

    def install(self, run: Runner) -> None:
        _make_empty(self.folder)
        build = self.folder / "build"
        run = replace(
            run,
            environment={
                **run.environment,
                "GOPATH": str(build / "path"),
                "GOCACHE": str(build / "cache"),
                "GOBIN": str(self.folder / "bin"),
            },
        )
        flags = ["-trimpath", "-ldflags", "-s -w"]
        if self.source is None:
            run(["go", "install", *flags, f"{self.package}@{self.version}"], timeout=1800)
        else:
            to = ["-mod=readonly", "-o", str(self.folder / "bin" / self.program)]
            run(["go", "build", *flags, *to, "."], timeout=1800, cwd=self.source)
        shutil.rmtree(build)
        _mark(self.folder, self.made_from())

    def made_from(self) -> str:
        """The version, or the hash of the module's files."""
        return self.version if self.source is None else _fingerprint(sorted(self.source.iterdir()))


@dataclass(frozen=True, kw_only=True)
class AptRecipe:
    """Packages of the Debian release that this machine runs; their versions are the release's."""

    name: str
    packages: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=lambda: {"DEBIAN_FRONTEND": "noninteractive"})

    def is_complete(self) -> bool:
        """Apt keeps the record; whether the programs are there is for the peers to say."""
        return True

    def install(self, run: Runner) -> None:
        if shutil.which("apt-get") is None:
            raise InstallFailed(f"this is no Debian; install what gives {', '.join(self.packages)}")
        if os.geteuid() != 0:
            raise InstallFailed(f"needs root: apt-get install {' '.join(self.packages)}")
        install = ["apt-get", "install", "-y", "--no-install-recommends", *self.packages]
        try:
            run(install, timeout=900)
        except InstallFailed:
            # The lists are missing or older than the archive: only then are they worth fetching.
            run(["apt-get", "update"], timeout=300)
            run(install, timeout=900)


@dataclass(frozen=True, kw_only=True)
class DebianRecipe:
    """A small Debian in one tar file, to make a container image of where none can be pulled.

    The certificates that this machine trusts go into it: an image built on it asks the registries by the same way.
    """

    name: str
    release: str
    packages: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=lambda: {"DEBIAN_FRONTEND": "noninteractive"})
    certificates: Path = CERTIFICATES

    @property
    def folder(self) -> Path:
        return cache_folder() / f"debian-{self.release}"

    def is_complete(self) -> bool:
        return _is_marked(self.folder, self.made_from())

    def install(self, run: Runner) -> None:
        if os.geteuid() != 0:
            raise InstallFailed("needs root, as debootstrap does")
        made_from = self.made_from()
        _make_empty(self.folder)
        root = self.folder / "root"
        run(
            ["debootstrap", "--variant=minbase", f"--include={','.join(self.packages)}", self.release, root],
            timeout=900,
        )
        if self.certificates.exists():
            shutil.copy(self.certificates, root / self.certificates.relative_to("/"))
        left_out = [f"--exclude=./{path}/*" for path in ("dev", "var/cache/apt", "var/lib/apt/lists")]
        run(["tar", "--numeric-owner", *left_out, "-C", root, "-cf", self.folder / "root.tar", "."], timeout=300)
        shutil.rmtree(root)
        _mark(self.folder, made_from)

    def made_from(self) -> str:
        """The hash of the release, the packages and this machine's certificates."""
        words = " ".join((self.release, *self.packages)).encode()
        return hashlib.sha256(
            words + (self.certificates.read_bytes() if self.certificates.exists() else b"")
        ).hexdigest()


def _fingerprint(files: list[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def _make_empty(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)


def _mark(folder: Path, fingerprint: str) -> None:
    (folder / ".complete").write_text(fingerprint)


def _is_marked(folder: Path, fingerprint: str) -> bool:
    mark = folder / ".complete"
    return mark.exists() and mark.read_text() == fingerprint
