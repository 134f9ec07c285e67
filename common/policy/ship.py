"""Policies for the package: `python -m congrasp.common.policy.ship FILE NAME`.

Writes the policy of a run into the package's folder, without its critic: half of the file, which
only training reads. A run keeps its critic in `policy.safetensors` and in its checkpoints.
"""

import argparse
import hashlib
import pathlib
from collections.abc import Sequence

from congrasp.common.policy import bundle as bundles
from congrasp.common.policy.pretrained import packaged_file


def ship(policy: pathlib.Path, target: pathlib.Path) -> None:
    """Writes a policy without its critic.

    Args:
      policy: file of the policy, which may be the target.
      target: file to write.

    Raises:
      CongraspError: the policy cannot be read, or the target not be written.
    """
    bundles.save(bundles.without_critic(bundles.load(policy)), target)


def main(arguments: Sequence[str] | None = None) -> None:
    """Ships the policy of the command line and prints its hashes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=pathlib.Path, help="policy.safetensors of a run")
    parser.add_argument("name", help="name of the policy: a hand, or such as allegro-student")
    options = parser.parse_args(arguments)
    target = packaged_file(options.name)
    ship(options.file, target)
    content = target.read_bytes()
    print(f"{target}: {len(content) / 1e6:.1f} MB")
    print(f"sha256       {hashlib.sha256(content).hexdigest()}")
    print(f"actor_sha256 {bundles.load(target).actor_sha256}")


if __name__ == "__main__":
    main()
