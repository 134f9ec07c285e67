"""Packages and addresses of the distribution; everything else is in pyproject.toml.

The package `congrasp` consists of its own folder and four others of the repository. They are listed
here by their true paths, so that a build needs none of the symbolic links in `congrasp/`.

The environment variable CONGRASP_REPOSITORY is the web address of the repository from which a
release is built.
"""

import os

from setuptools import find_packages, setup

FOLDERS = ("common", "actors", "learner", "services")

packages = ["congrasp"]
for folder in FOLDERS:
    packages.append(f"congrasp.{folder}")
    packages += [f"congrasp.{folder}.{name}" for name in find_packages(folder)]

urls = {}
repository = os.environ.get("CONGRASP_REPOSITORY", "").rstrip("/")
if repository:
    urls["Source"] = repository
    urls["Issues"] = f"{repository}/issues"
    urls["Changelog"] = f"{repository}/blob/main/CHANGELOG.md"
    urls["Documentation"] = f"{repository}/tree/main/docs"

setup(
    packages=packages,
    package_dir={f"congrasp.{folder}": folder for folder in FOLDERS},
    project_urls=urls,
)
