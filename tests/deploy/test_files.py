"""What is in deploy/: valid by the published schemas, and made of command lines that this version
understands.
"""

import itertools
import json
import pathlib
import re
import shlex
import shutil
import subprocess
import sys

import kubernetes_validate
import pytest
import yaml

from congrasp.common.transport.ports import free_port
from congrasp.services.cli.main import load
from congrasp.services.ops.metrics import ActorMetrics, LearnerMetrics, ServerMetrics
from congrasp.services.ops.metrics_endpoint import serve_metrics
from tests.conftest import ROOT
from tests.services.ops.test_metrics import STATUS, scrape

DEPLOY = ROOT / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
SCRIPTS = sorted(DEPLOY.rglob("*.sbatch"))
VERSIONS = ("1.29", "1.37")  # of Kubernetes: the oldest and the newest


def manifests(text=None):
    files = [text] if text else [path.read_text() for path in KUBERNETES.glob("*.yaml")]
    documents = []
    for file in files:
        for document in yaml.safe_load_all(file):
            if "apiVersion" in document:
                documents.append(document)
    return [
        document for document in documents if not document["apiVersion"].startswith("kustomize")
    ]


def compose_commands():
    for name, service in yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"].items():
        words = [re.sub(r"\$\{\w+:-(\w+)\}", r"\1", word) for word in service["command"]]
        yield (
            f"compose {name}",
            shlex.split(words[0].split("congrasp")[-1]) if name == "certs" else words,
        )
        if test := service.get("healthcheck", {}).get("test"):
            yield f"compose {name} health", test[2:]


def kubernetes_commands():
    for document in manifests():
        if document["kind"] in ("StatefulSet", "Deployment"):
            (container,) = document["spec"]["template"]["spec"]["containers"]
            yield (
                f"kubernetes {container['name']}",
                [re.sub(r"\$\((\w+)\)", "human", word) for word in container["args"]],
            )
            if "exec" in container.get("readinessProbe", {}):
                yield (
                    f"kubernetes {container['name']} probe",
                    container["readinessProbe"]["exec"]["command"][1:],
                )


def unit_commands():
    for unit in UNITS:
        text = unit.read_text().replace("\\\n", "")
        pairs = " ".join(re.findall("^Environment=(.*)", text, re.M)).split()
        values = dict(pair.split("=", 1) for pair in pairs)
        command = re.search("^ExecStart=(.*)", text, re.M)[1]
        for name, value in values.items():
            command = command.replace(f"${{{name}}}", value).replace(f"${name}", value)
        yield f"systemd {unit.name}", shlex.split(command.replace("%d", "/run/credentials"))[1:]


def docker_commands():
    text = (DEPLOY / "Dockerfile").read_text()
    yield "docker", json.loads(re.search("^CMD (.*)", text, re.M)[1])
    yield "docker health", json.loads(re.search("^HEALTHCHECK .* CMD (.*)", text, re.M)[1])[1:]


COMMANDS = [*compose_commands(), *kubernetes_commands(), *unit_commands(), *docker_commands()]


@pytest.mark.parametrize(
    "arguments", [arguments for _, arguments in COMMANDS], ids=[name for name, _ in COMMANDS]
)
def test_command_lines_are_understood(arguments):
    """An option that no longer exists ends the parser, and so the test."""
    assert callable(load(arguments[0])(arguments[1:]))


def test_compose_file_fits_the_schema_of_compose():
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"]
    done = subprocess.run(
        [*command, DEPLOY / "compose.yaml"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("version", VERSIONS)
def test_manifests_fit_the_schemas_of_kubernetes(version):
    documents = manifests()
    for document in documents:
        kubernetes_validate.validate(document, version, strict=True)
    assert {"StatefulSet", "Deployment", "Service", "HorizontalPodAutoscaler", "NetworkPolicy"} < {
        document["kind"] for document in documents
    }


def test_a_mistake_in_a_manifest_is_found():
    (learner,) = (document for document in manifests() if document["kind"] == "StatefulSet")
    learner["spec"]["replica"] = learner["spec"].pop("replicas")
    with pytest.raises(kubernetes_validate.ValidationError, match="replica"):
        kubernetes_validate.validate(learner, VERSIONS[-1], strict=True)


def test_manifests_name_one_another_rightly():
    documents = manifests()
    names = {(document["kind"], document["metadata"]["name"]) for document in documents}
    labels = {}
    ports = {}
    for document in documents:
        if document["kind"] in ("StatefulSet", "Deployment"):
            template = document["spec"]["template"]
            labels[document["metadata"]["name"]] = template["metadata"]["labels"]
            assert document["spec"]["selector"]["matchLabels"] == template["metadata"]["labels"]
            (container,) = template["spec"]["containers"]
            ports[document["metadata"]["name"]] = {
                port["containerPort"] for port in container["ports"]
            }
            mounted = {mount["name"] for mount in container["volumeMounts"]}
            claims = {
                claim["metadata"]["name"]
                for claim in document["spec"].get("volumeClaimTemplates", ())
            }
            assert mounted == {volume["name"] for volume in template["spec"]["volumes"]} | claims
            assert template["spec"]["securityContext"]["runAsNonRoot"]
    for document in documents:
        if document["kind"] == "Service":
            assert document["spec"]["selector"] == labels[document["metadata"]["name"]]
            assert {port["port"] for port in document["spec"]["ports"]} <= ports[
                document["metadata"]["name"]
            ]
        elif document["kind"] == "PodDisruptionBudget":
            assert document["spec"]["selector"]["matchLabels"] in labels.values()
        elif document["kind"] == "HorizontalPodAutoscaler":
            target = document["spec"]["scaleTargetRef"]
            assert (target["kind"], target["name"]) in names
            (metric,) = document["spec"]["metrics"]
            adapter = yaml.safe_load((KUBERNETES / "prometheus-adapter.yaml").read_text())["rules"][
                "external"
            ]
            assert metric["external"]["metric"]["name"] in {rule["name"]["as"] for rule in adapter}


@pytest.mark.skipif(
    not shutil.which("kubectl"), reason="kubectl, which builds kustomizations, is not here"
)
def test_kustomizations_build(tmp_path):
    shutil.copytree(KUBERNETES, tmp_path / "k")
    for name in ("learner.0", "actor.0", "server.0", "client.0"):
        (tmp_path / "k" / "certificates" / name).mkdir()
        for file in ("ca.crt", "tls.crt", "tls.key"):
            (tmp_path / "k" / "certificates" / name / file).write_text("x")
    built = []
    for folder in (tmp_path / "k", tmp_path / "k" / "certificates"):
        done = subprocess.run(
            ["kubectl", "kustomize", folder], capture_output=True, text=True, timeout=60, check=True
        )
        built += manifests(done.stdout)
    secrets = {document["metadata"]["name"] for document in built if document["kind"] == "Secret"}
    for document in built:
        kubernetes_validate.validate(document, VERSIONS[-1], strict=True)
        assert document["kind"] == "Namespace" or document["metadata"]["namespace"] == "congrasp"
        if document["kind"] in ("StatefulSet", "Deployment"):
            used = {
                volume.get("secret", {}).get("secretName")
                for volume in document["spec"]["template"]["spec"]["volumes"]
            }
            assert used - {None} <= secrets


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not here")
def test_units_are_valid_and_confined(tmp_path):
    copies = [tmp_path / unit.name for unit in UNITS]
    for unit, copy in zip(UNITS, copies, strict=True):
        copy.write_text(unit.read_text().replace("/opt/congrasp/bin/congrasp", sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", *copies],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not any(copy.name in done.stderr for copy in copies), done.stderr
    for copy in copies:
        confined = [
            "systemd-analyze",
            "security",
            "--offline=yes",
            "--threshold=25",
            "--no-pager",
            copy,
        ]
        done = subprocess.run(confined, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_pass_shellcheck(script):
    for command in (
        ["bash", "-n"],
        [str(pathlib.Path(sys.executable).with_name("shellcheck")), "--shell=bash"],
    ):
        done = subprocess.run(
            [*command, script], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("variables", "port"),
    [
        ({"SLURM_JOB_ID": "1"}, 15010),
        ({"SLURM_JOB_ID": "2"}, 15020),
        ({"SLURM_JOB_ID": "2", "CONGRASP_PORT": "9000"}, 9000),
    ],
)
def test_slurm_tasks_are_ranks_of_one_run(tmp_path, variables, port):
    """With stand-ins for Slurm's commands, the script starts the learner's ranks with arguments
    that it understands.
    """
    stubs = {
        "scontrol": "echo node-7; echo node-8",
        "srun": (
            'while [ "$1" != bash ]; do shift; done; for i in 0 1; do SLURM_PROCID=$i "$@"; done'
        ),
        "congrasp": 'for word in "$@"; do echo "$word"; done >> "$OUT/$SLURM_PROCID"',
    }
    for name, body in stubs.items():
        (tmp_path / name).write_text(f"#!/usr/bin/env bash\n{body}\n")
        (tmp_path / name).chmod(0o755)
    environment = {
        "SLURM_NTASKS": "2",
        **variables,
        "SLURM_JOB_NODELIST": "node-[7-8]",
        "OUT": str(tmp_path),
        "HOME": str(tmp_path),
    }
    script = [
        "bash",
        DEPLOY / "slurm" / "train.sbatch",
        "human",
        tmp_path / "a run",
        "--updates",
        "9",
    ]
    subprocess.run(
        script, env={**environment, "PATH": f"{tmp_path}:/usr/bin:/bin"}, timeout=60, check=True
    )
    for rank in range(2):
        arguments = (tmp_path / str(rank)).read_text().splitlines()
        keywords = load(arguments[0])(arguments[1:]).keywords
        options = keywords["options"]
        assert options.rank == rank
        assert options.ranks == 2
        assert options.coordinator == f"node-7:{port}"
        assert options.listen == f"tcp/127.0.0.1:{port + 2}"
        assert options.run_dir == tmp_path / "a run"
        assert keywords["config"].updates == 9
        assert options.inside


@pytest.mark.parametrize(
    ("rank", "learner", "words"),
    [
        (0, "", ["learner", "--inside"]),
        (1, "", ["actor", "--certs"]),
        (0, "10.0.0.5", ["actor", "--certs"]),
    ],
)
def test_nodes_of_a_cloud_are_a_learner_and_its_actors(tmp_path, rank, learner, words):
    """With a stand-in for the package, each node runs a command that this version understands."""
    task = yaml.safe_load((DEPLOY / "skypilot.yaml").read_text())
    stubs = tmp_path / "congrasp" / "bin"
    stubs.mkdir(parents=True)
    for name, body in {
        "congrasp": 'printf "%s\\n" "$@" > "$OUT"',
        "sudo": "cat > /dev/null",
    }.items():
        (stubs / name).write_text(f"#!/usr/bin/env bash\n{body}\n")
        (stubs / name).chmod(0o755)
    nodes = {"SKYPILOT_NODE_IPS": "10.0.0.5\n10.0.0.6", "SKYPILOT_NODE_RANK": str(rank)}
    environment = {
        **nodes,
        **task["envs"],
        "LEARNER": learner,
        "HOME": str(tmp_path),
        "OUT": str(tmp_path / "said"),
    }
    path = f"{stubs}:/usr/bin:/bin"
    subprocess.run(
        ["bash", "-c", task["run"]], env={**environment, "PATH": path}, check=True, timeout=60
    )
    command, *rest = (tmp_path / "said").read_text().splitlines()
    assert command == words[0]
    assert words[1] in rest
    load(command)(rest)
    check = [str(pathlib.Path(sys.executable).with_name("shellcheck")), "--shell=bash", "-"]
    for part in ("setup", "run"):
        done = subprocess.run(
            check, input=task[part], capture_output=True, text=True, timeout=60, check=False
        )
        assert done.returncode == 0, done.stdout
    assert {path.partition("/")[0] for path in task["file_mounts"].values()} == {"certs"}


# --- Grafana ---


DASHBOARD = json.loads((ROOT / "deploy" / "grafana" / "congrasp.json").read_text())
UPDATE = ("episode/success", "episode/return", "update_seconds", "wait_seconds")
WORDS = {"min", "max", "sum", "by", "le", "rate", "histogram_quantile", "outcome"}


def test_every_expression_names_metrics_that_are_exposed():
    learner = LearnerMetrics(lambda: STATUS)
    actor = ActorMetrics()
    server = ServerMetrics()
    port = free_port()
    learner.update(dict.fromkeys(UPDATE, 1.0))
    server.health = lambda: {"ready": True, "version": 5, "queue": 2}
    server.answer("answered", 0.01)
    server.batch(3)
    with serve_metrics(port, "127.0.0.1", learner, actor, server):
        metrics = scrape(port)
    names = {name for name, *_ in metrics}
    labels = set()
    for _, *of_metric in metrics:
        labels.update(of_metric)
    expressions = []
    for panel in DASHBOARD["panels"]:
        expressions += [target["expr"] for target in panel.get("targets", [])]
    assert len(expressions) > 20
    for expression in expressions:
        bare = re.sub(r"\{[^}]*\}|\[[^]]*\]", "", expression)
        used = set(re.findall(r"[a-z_]+", bare)) - WORDS
        assert used, expression
        assert used <= names, expression
        for value in re.findall(r'(?:figure|outcome|role)="([^"]+)"', expression):
            assert value in labels, expression
        assert all(
            expression.count(pair[0]) == expression.count(pair[1]) for pair in ("()", "{}", "[]")
        )
        assert all('job=~"$job"' in selector for selector in re.findall(r"\{[^}]*\}", expression))


def test_the_panels_do_not_overlap():
    taken = set()
    for panel in DASHBOARD["panels"]:
        at = panel["gridPos"]
        columns = range(at["x"], at["x"] + at["w"])
        rows = range(at["y"], at["y"] + at["h"])
        cells = set(itertools.product(columns, rows))
        assert not cells & taken
        assert max(x for x, _ in cells) < 24
        taken |= cells
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
