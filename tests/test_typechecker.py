"""The type checker that the tests install."""

from importlib.util import find_spec
from pathlib import Path

import nerf_lightning


def test_every_module_is_checked_but_the_compiled_ones():
    root = Path(nerf_lightning.__file__).parents[1]
    files = (file.relative_to(root).with_suffix("") for file in (root / "nerf_lightning").rglob("*.py"))
    names = {".".join(file.parts).removesuffix(".__init__") for file in files}
    unchecked = {name for name in names if not type(find_spec(name).loader).__module__.startswith("jaxtyping")}
    compiled = {name for name in names if name.startswith("nerf_lightning.kernels.cpu")}
    # The hook takes packages with all that is in them: these two hold the compiled one, and nothing but imports themselves.
    assert unchecked == compiled | {"nerf_lightning", "nerf_lightning.kernels"}
