"""Titles and units of a run's metrics, for people."""

from congrasp.common.task.constraints import CONSTRAINTS
from congrasp.common.task.metrics import DIVERGED

_KINDS = {"rad": "angle", "m": "distance", "": "share of links"}
_TITLES = {
    "transitions": ("Steps learnt from", "environment steps"),
    "steps_per_second": ("Throughput", "control steps/s"),
    "wait_seconds": ("Waiting for rollouts", "s per update"),
    "update_seconds": ("Duration of an update", "s"),
    "batches_dropped": ("Dropped batches so far", "batches"),
    "staleness_mean": ("Mean policy lag", "versions"),
    "staleness_max": ("Largest policy lag", "versions"),
    "episodes": ("Episodes that ended in the batch", "episodes"),
    "policy_loss": ("Policy loss", "normalised advantage"),
    "value_loss": ("Value loss", "squared scaled return"),
    "entropy": ("Entropy of the policy", "nats"),
    "kl": ("KL divergence of an update", "nats"),
    "imitation_kl": ("KL divergence from student to teacher", "nats"),
    "learning_rate": ("Learning rate", "per step of Adam"),
    "clip_fraction": ("Clipped samples", "share"),
    "actor_grad_norm": ("Gradient norm of the actor", "before clipping"),
    "critic_grad_norm": ("Gradient norm of the critic", "before clipping"),
    "action_std": ("Exploration noise", "units of action"),
    "advantage_std": ("Standard deviation of advantages", "scaled return"),
    "explained_variance": ("Explained variance of the critic", "share"),
    "importance_mean": ("Mean importance weight", "ratio"),
    "importance_max": ("Largest importance weight", "ratio"),
    "importance_truncated": ("Truncated importance weights", "share of samples"),
    "behaviour_kl": ("KL divergence by policy lag", "nats"),
    "reward_mean": ("Mean reward", "scaled reward a step"),
    "return_mean": ("Mean return of the batch", "scaled return"),
    "value_mean": ("Mean value estimate", "scaled return"),
    "rollouts": ("Rollouts so far", "rollouts"),
    "share/waiting": ("Waiting for a ticket", "share of the actor's time"),
    "share/transport": ("Weights and rollouts in transport", "share of the actor's time"),
    "episodes_left_out": ("Episodes with metrics that are not finite", "episodes"),
    "overflow": ("Steps without room for all contacts", "steps"),
    "contacts_peak": ("Peak occupancy of the contact buffer", "share"),
    "rows_peak": ("Peak occupancy of the constraint buffer", "share"),
    "weight_most": ("Most frequent object against the average", "factor"),
    "weight_least": ("Rarest object against the average", "factor"),
    "episode/success": ("Success", "share of episodes"),
    "episode/held": ("Held to the end", "share of episodes"),
    "episode/return": ("Return of an episode", "reward"),
    "episode/length": ("Length of an episode", "control steps"),
    "episode/links_at_removal": ("Links in contact at table removal", "links"),
    "episode/moved_at_removal": ("Object's displacement at table removal", "m"),
    "episode/force_sum": ("Contact force of all links", "N"),
    "episode/force_link_max": ("Contact force of the hardest pressing link", "N"),
    f"episode/{DIVERGED}": ("Diverged physics", "share of episodes"),
    "episode/object_index": ("Mean index of the object", ""),
    "success/heading": ("Success with the heading alone", "share of episodes"),
    **{
        f"success/{constraint.name}": (f"Success with {constraint.title}", "share of episodes")
        for constraint in CONSTRAINTS
        if constraint.blocks
    },
    **{
        f"episode/mask_{block}": (f"Episodes with {block.replace('_', ', ')}", "share of episodes")
        for constraint in CONSTRAINTS
        for block in constraint.blocks
    },
    **{
        f"episode/{spec.name}": (f"{constraint.title.capitalize()} error: {_KINDS[spec.unit]}", spec.unit or "share")
        for constraint in CONSTRAINTS
        for spec in constraint.errors
    },
}
_UNITS = {"_per_second": "1/s", "_seconds": "s", "_rad": "rad", "_m": "m", "_bytes": "bytes", "_ratio": "share"}
"""Units of metrics that have no title here, by how their names end."""


def titled(metric: str) -> tuple[str, str]:
    """Title and unit of a metric by its name after the process; one that is not known gets its name in words."""
    if metric in _TITLES:
        return _TITLES[metric]
    group, _, name = metric.rpartition("/")
    ending = next((end for end in _UNITS if name.endswith(end)), "")
    words = name.removesuffix(ending).replace("_", " ")
    if group == "term":
        return words.capitalize(), "reward"
    if group == "failure":
        return f"Lost objects: {words}", "share of episodes"
    return (f"{group.replace('_', ' ')}: {words}" if group else words).capitalize(), _UNITS.get(ending, "")
