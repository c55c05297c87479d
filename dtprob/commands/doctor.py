"""What `dtprob doctor` shows: what this machine can do, and the command that brings what is missing."""

import importlib.metadata
import json as json_format
import os
import platform
from collections.abc import Iterable
from dataclasses import asdict, dataclass

from dtprob import __version__, xla
from dtprob.data.location import measured_data
from dtprob.data.uwb_apartment import NAME
from dtprob.errors import InputError
from dtprob.raytracing import llvm


@dataclass(frozen=True)
class Check:
    """One ability.

    Attributes:
        ability: what one can do with it.
        ok: whether it is there.
        found: what is there, or what is missing.
        remedy: the command that brings it; None where it is there.
    """

    ability: str
    ok: bool
    found: str
    remedy: str | None = None


def run(*, json: bool) -> None:
    """Print all checks.

    Args:
        json: as an object with `dtprob` (the version) and `checks`.
    """
    checks = list(all_checks())
    if json:
        content = {"dtprob": __version__, "checks": [asdict(check) for check in checks]}
        print(json_format.dumps(content, indent=2))
        return
    print(f"dtprob {__version__}, Python {platform.python_version()}, {os.cpu_count()} cores")
    for check in checks:
        print(f"{'ok     ' if check.ok else 'missing'}  {check.ability}: {check.found}")
        if check.remedy:
            print(f"         {check.remedy}")


def all_checks() -> Iterable[Check]:
    """Every check, without loading a ray tracer."""
    yield _package("infer and diagnose", "numpyro")
    yield _accelerator()
    yield _compiler()
    sionna = _package("trace scenes", "sionna-rt")
    yield sionna
    if sionna.ok:
        yield _libllvm()
    yield _package("multi-agent environments in PettingZoo's form", "pettingzoo")
    yield _package("read Zarr files", "zarr")
    yield _measured()


def _package(ability: str, package: str) -> Check:
    try:
        return Check(ability, ok=True, found=f"{package} {importlib.metadata.version(package)}")
    except importlib.metadata.PackageNotFoundError:
        return Check(ability, ok=False, found=f"no {package}", remedy=f"pip install {package}")


def _accelerator() -> Check:
    import jax  # noqa: PLC0415  (takes a second, and only this check needs it)

    platforms = sorted({device.platform for device in jax.devices()})
    found = f"jax {jax.__version__} on {', '.join(platforms)}"
    if platforms == ["cpu"] and llvm.has_cuda():
        return Check("compute on the GPU", ok=False, found=found, remedy="pip install 'jax[cuda12]'")
    return Check("compute", ok=True, found=found)


def _compiler() -> Check:
    version = xla.version()
    if xla.miscompiles():
        found = f"jaxlib {version} miscompiles a product followed by a mean"
        return Check("trust compiled results", ok=False, found=found, remedy=f"export XLA_FLAGS='{xla.FLAG}'")
    guard = f" (with XLA_FLAGS={xla.FLAG}, as your own programs need too)" if version in xla.FAULTY else ""
    return Check("trust compiled results", ok=True, found=f"jaxlib {version}{guard}")


def _libllvm() -> Check:
    named = os.environ.get(llvm.VARIABLE)
    libraries = llvm.find_libraries()
    chosen = llvm.choose_library(libraries)
    if chosen is not None:
        version = ".".join(map(str, chosen.version or ()))
        return Check("trace scenes on the CPU", ok=True, found=f"libLLVM {version} at {named or chosen.path}")
    versions = [".".join(map(str, one.version)) for one in libraries if one.version]
    found = f"libLLVM {', '.join(versions)} only" if versions else "no libLLVM"
    return Check(
        "trace scenes on the CPU",
        ok=False,
        found=f"{found} ({llvm.CONFIRMED} or newer needed)",
        remedy=llvm.INSTALL,
    )


def _measured() -> Check:
    try:
        return Check("tests on measured data", ok=True, found=str(measured_data(NAME)))
    except InputError:
        remedy = "export DTPROB_DATA=FOLDER   (the folder that holds uwb_apartment)"
        return Check("tests on measured data", ok=False, found=f"no {NAME}", remedy=remedy)
