"""The dashboard asks for metrics that there are."""

import json
import re

from congrasp.common.transport.ports import free_port
from congrasp.services.ops.metrics import ActorMetrics, LearnerMetrics, ServerMetrics, exposed
from tests.conftest import ROOT
from tests.services.ops.test_metrics import STATUS, scrape

DASHBOARD = json.loads((ROOT / "deploy" / "grafana" / "congrasp.json").read_text())
UPDATE = ("episode/success", "episode/return", "update_seconds", "wait_seconds")
WORDS = {"min", "max", "sum", "by", "le", "rate", "histogram_quantile", "outcome"}


def test_every_expression_names_metrics_that_are_exposed():
    learner, actor, server, port = LearnerMetrics(lambda: STATUS), ActorMetrics(), ServerMetrics(), free_port()
    learner.update(dict.fromkeys(UPDATE, 1.0))
    server.health = lambda: {"ready": True, "version": 5, "queue": 2}
    server.answer("answered", 0.01)
    server.batch(3)
    with exposed(port, "127.0.0.1", learner, actor, server):
        found = scrape(port)
    names, labels = {name for name, *_ in found}, {label for _, *rest in found for label in rest}
    expressions = [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", [])]
    assert len(expressions) > 20
    for expression in expressions:
        bare = re.sub(r"\{[^}]*\}|\[[^]]*\]", "", expression)
        used = set(re.findall(r"[a-z_]+", bare)) - WORDS
        assert used and used <= names, expression
        for value in re.findall(r'(?:figure|outcome|role)="([^"]+)"', expression):
            assert value in labels, expression
        assert all(expression.count(pair[0]) == expression.count(pair[1]) for pair in ("()", "{}", "[]"))
        assert all('job=~"$job"' in selector for selector in re.findall(r"\{[^}]*\}", expression))


def test_the_panels_do_not_overlap():
    taken = set()
    for panel in DASHBOARD["panels"]:
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert not cells & taken and max(x for x, _ in cells) < 24
        taken |= cells
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
