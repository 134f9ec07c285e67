"""Zenoh without the project: peers of its own interface, for tests and benchmarks."""

import json

import zenoh


def bare_session(mode: str, *, shared_memory: bool = False, **endpoints: str) -> zenoh.Session:
    """A session that listens at, or connects to, an endpoint; Zenoh's defaults bound nothing of
    it.
    """
    settings = {f"{way}/endpoints": [endpoint] for way, endpoint in endpoints.items()}
    settings |= {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": shared_memory,
    }
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)
