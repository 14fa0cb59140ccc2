"""Command lines and YAML documents from a grammar: what users type, and what they should not."""

from collections.abc import Mapping
from random import Random
from typing import Any

import yaml

from benchmarks.hostile import values
from benchmarks.hostile.case import Command

ENDLESS = ("budget.", "trainer.max_", "target.", "seconds", "within_db", "smallest_within_db", "steps", "seeds", "fps")
"""Options that may ask for any amount of time: a command that takes long is right then. They get no large numbers."""
EVERYTHING = ("methods",)
"""Options where null stands for all there are: right as well, and hours of work with a suite's other defaults."""
NOT_ASKED = (
    "trainer.devices", "trainer.strategy", "trainer.num_nodes", "trainer.accelerator", "trainer.profiler", "compile", "kernels",
    "dataset.url", "dataset.download", "resume", "workers",
)  # fmt: skip
"""Options that start other processes or compilers, or ask the network."""
WRITTEN = ("output", "name", "print", "hydra.run.dir")
"""Options that say where to write: nothing outside of the case's folder may be named there."""
PLACES = (
    "scene.npz", "scene.npz/x", "", ".", "new", "new/x.webp", "new.png", "new.nosuch", "x" * 5000, "x/" * 2500, "a\0b",
    "é\u202e", "%s", "'", "[", "/dev/null/x", "~nosuchuser/x", "/proc/nosuch/x", "new.npz", "new.html", "new folder",
)  # fmt: skip
WORDS = (
    "null", "nan", "inf", "-inf", "1e39", "1e300", "1e-320", "-0.0", "0", "-1", "1", "2", "0.5", "1e400", "1_000", "0x10",
    "true", "false", "", "''", '""', "[]", "{}", "[1,2,3]", "{a:1}", "[[]]", "[null]", "a,b", "'a b'", "abc", "${nope}",
    "${seed}", "${oc.env:NOSUCH}", "${oc.env:HOME", "[1", "{a", "'", "a=b", "\\", "x" * 5000, "é", "\u202e", "1,nan", "???",
    "range(3)", "choice(1,2)", "glob(*)", "int(1.5)", "[" * 200 + "]" * 200, "auto", "~nosuchuser", "../x", "nosuch.npz",
)  # fmt: skip
LARGE = tuple(str(one) for one in values.INTEGERS if one > 2**32)
FLAGS = (
    "--nope", "--config-name=nope", "--config-dir=nowhere", "--config-path=/nowhere", "-m", "--multirun", "--cfg", "--cfg=job",
    "--cfg=nope", "--help", "--hydra-help", "--info=all", "--info=nope", "--resolve", "--package=nope", "-x", "--", "-",
    "--version", "--shell-completion", "--run", "--experimental-rerun=nope", "-cn", "-h=1", "---", "--config-name",
)  # fmt: skip
BROKEN = (
    "", "=", "=1", "nope=1", "nope", "a.b.c=1", "model", "model.=1", ".model=1", "model..width=1", "+", "~", "+=1", "~nope",
    "+foo=1", "++foo=1", "+foo.bar=1", "++model.nope=1", "+model=mlp", "model@x=mlp", "model@:_global_=mlp", "~model",
    "~model.width", "seed", "seed==1", "seed=1=2", "seed =1", "seed= 1", "'seed=1'", "seed:1", "hydra=nope", "hydra.x=1",
    "é=1", "a b=1", "$x=1", "model={", "model=[mlp,voxels]", "+experiment=nope", "+experiment=", "+experiment=nope.yaml",
    "+experiment=picture.png", "hydra.job.chdir=nope", "hydra/job_logging=nope", "hydra.verbose=nope", "hydra.mode=nope",
    "resume=scene.npz", "resume=picture.png", "resume=nowhere", "resume=", "resume=null", "resume=run/config.yaml", "resume=.",
    "resume=~nosuchuser/x", "resume=" + "x" * 5000, "resume=[1,2]", "resume=nan", "resume=1e300", "resume=a,b", "resume='",
)  # fmt: skip
GROUPS = (
    "dataset", "optimizer", "model", "sampler", "renderer", "refine", "schedule", "callbacks", "logger", "trainer", "recipe",
)  # fmt: skip
CHOICES = (
    "null", "nope", "", "[]", "[a,b]", "x" * 5000, "1", "nan", "true", "../model/mlp", "/nowhere", "{a:1}", "mlp", "voxels",
    "hashgrid", "uniform", "stratified", "importance", "proposal", "occupancy", "both", "light", "poses", "auto", "constant",
    "cosine", "adamw", "siren", "fourier", "picture", "photos", "mlp_small", "published", "tensorboard",
)  # fmt: skip


def word(rng: Random, key: str) -> str:
    """A hostile value of an option."""
    if key in WRITTEN:
        return rng.choice(PLACES)
    if rng.random() < 0.25 and not key.startswith(ENDLESS):
        return rng.choice(LARGE)
    chosen = rng.choice(WORDS)
    return "nope" if key in EVERYTHING and chosen == "null" else chosen


def argument(rng: Random, verb: str, options: Mapping[str, str]) -> str:
    """A hostile argument for a verb with some options."""
    kind = rng.randrange(20)
    if kind == 0:
        return rng.choice(FLAGS)
    if kind == 1:
        return rng.choice(BROKEN)
    if kind == 2 and verb == "train":
        return f"{rng.choice(('', '', '', '+', '~'))}{rng.choice(GROUPS)}={rng.choice(CHOICES)}"
    known = [key for key in options if key not in NOT_ASKED and not key.endswith("_target_")]
    groups: dict[str, list[str]] = {"hydra": ["hydra.run.dir"]} if verb == "train" else {}
    for one in known:
        groups.setdefault(one.split(".")[0], []).append(one)
    key = rng.choice(groups[rng.choice(list(groups))])  # callbacks and models have most of the options
    form = rng.randrange(12)
    if form == 0:
        return f"~{key}"
    if form == 1:
        return f"{rng.choice(('+', '++'))}{key}{rng.choice(('', 'x', '.x'))}={word(rng, key)}"
    return f"{key}={word(rng, key)}"


def spoilt(good: Command, rng: Random, options: Mapping[str, Mapping[str, str]]) -> tuple[Command, str]:
    """A good command line with one to three hostile arguments more, and these."""
    of_verb = options["config" if good.verb == "train" else good.verb]
    more = [argument(rng, good.verb, of_verb) for _ in range(rng.choice((1, 1, 1, 2, 3)))]
    arguments = list(good.arguments)
    for one in more:
        at = rng.choice((0, *[len(arguments)] * 4))  # of two that name one option the last counts
        arguments.insert(at, one.replace("\0", "") if rng.random() < 0.9 else one)
    if good.verb == "train" and rng.random() < 0.05:
        key = rng.choice(("seed", "dataset.rays", "optimizer.lr", "model", "name"))
        more.append(f"{key}={rng.choice(('0,1', '1,nan', 'a,b', '0,0', 'mlp,nope', 'null,1'))}")
        arguments += ["-m", more[-1]]
    whole = tuple(
        one.encode("utf-8", "replace").decode().replace("\0", "") for one in arguments
    )  # none can be given more
    return Command(good.module, whole), "; ".join(one[:60] or "''" for one in more)


def document(rng: Random, depth: int = 0) -> Any:
    """A tree of plain values that means nothing."""
    if depth > 3 or rng.random() < 0.4:
        return values.plain(rng)
    keys = ("model", "tags", "rungs", "defaults", "_target_", "x", 0, 1, "width", "budget", "", "hydra", "seed")
    if rng.random() < 0.6:
        return {rng.choice(keys): document(rng, depth + 1) for _ in range(rng.randrange(5))}
    return [document(rng, depth + 1) for _ in range(rng.randrange(4))]


def yaml_text(rng: Random) -> str:
    """A YAML document from the grammar: well formed or not quite."""
    text = yaml.safe_dump(document(rng), sort_keys=False)
    match rng.randrange(6):
        case 0:
            return text.replace("\n", "\n\t", 1)
        case 1:
            return "---\n" + text + "---\n" + text
        case 2:
            return "%YAML 9.9\n---\n" + text
        case 3:
            return text[: rng.randrange(1 + len(text))]
    return text
