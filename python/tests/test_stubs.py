"""Type stubs of the native module, and the names of the package."""

import ast
import inspect
from pathlib import Path

import mujoco_drones_gym
from mujoco_drones_gym import _native

PACKAGE = Path(mujoco_drones_gym.__file__).parent


def parameters(function):
    signature = inspect.signature(function)
    return [name for name in signature.parameters if name not in ("self", "cls")]


def declared(function):
    return [argument.arg for argument in function.args.args if argument.arg not in ("self", "cls")]


def test_stubs_declare_what_the_native_module_has():
    tree = ast.parse((PACKAGE / "_native.pyi").read_text())
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    public = {name: value for name, value in vars(_native).items() if not name.startswith("_")}
    assert set(classes) == {name for name, value in public.items() if inspect.isclass(value)}
    assert set(functions) == {name for name, value in public.items() if inspect.isbuiltin(value)}
    for name, node in functions.items():
        assert declared(node) == parameters(public[name]), name
    for name, node in classes.items():
        own = vars(public[name])
        members = {member.name: member for member in node.body if isinstance(member, ast.FunctionDef)}
        constructor = members.pop("__init__", None)
        if constructor is not None:
            assert declared(constructor) == parameters(public[name]), name
        assert set(members) == {member for member in own if not member.startswith("__")}, name
        for member, function in members.items():
            value = getattr(public[name], member)
            assert value.__doc__, f"{name}.{member}"
            if callable(value):
                assert declared(function) == parameters(value), f"{name}.{member}"


def test_every_name_of_the_package_exists():
    assert set(mujoco_drones_gym.__all__) == {"__version__", *mujoco_drones_gym._MODULES} - {
        "MultiAgentAviary",
        "parallel_env",
    }
    for name in mujoco_drones_gym.__all__:
        assert name in dir(mujoco_drones_gym) and getattr(mujoco_drones_gym, name)
    assert (PACKAGE / "py.typed").is_file()


def test_public_functions_have_docstrings():
    missing = []
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        if ast.get_docstring(tree) is None:
            missing.append(path.name)
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                members = [m for m in node.body if isinstance(m, ast.FunctionDef)]
                setters = {m for m in members for d in m.decorator_list if ast.unparse(d).endswith(".setter")}
                public = [m for m in members if not m.name.startswith("_") and m not in setters]
                missing += [f"{path.name}: {m.name}" for m in [node, *public] if ast.get_docstring(m) is None]
    assert not missing, missing
