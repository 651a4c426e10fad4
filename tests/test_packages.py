"""Every folder with code is a package of the installed program: one that the list leaves out is silently missing."""

from __future__ import annotations

import tomllib

from places import ROOT


def test_all_folders_with_code_are_installed():
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders: dict[str, str] = setuptools["package-dir"]
    data: dict[str, list[str]] = setuptools["package-data"]
    wanted = {
        ".".join((package, *path.parent.relative_to(ROOT / folder).parts))
        for package, folder in folders.items()
        for path in (ROOT / folder).rglob("*.py")
    }
    # folders that hold data alone are packages too
    assert set(setuptools["packages"]) == wanted | set(data)
    for package, patterns in data.items():
        top = max((name for name in folders if f"{package}.".startswith(f"{name}.")), key=len)
        folder = ROOT.joinpath(folders[top], *package.removeprefix(top).split("."))
        assert all(list(folder.glob(pattern)) for pattern in patterns), package
