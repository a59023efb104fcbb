"""Builders of Blender shader node trees, with one method per kind of node."""

from __future__ import annotations

from typing import Any

import bpy

from dataset_builder.scene.model import Colour

Socket = Any
"""An output socket of a node (``bpy.types.NodeSocket``)."""


class NodeTreeBuilder:
    """A node tree under construction; the methods add nodes and return output sockets."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self._tree = tree

    def node(self, kind: str, inputs: dict[str | int, Any], **settings: Any) -> Any:
        """Add and return a node; ``inputs`` are sockets to link or values to set, ``settings`` its properties."""
        node = self._tree.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for key, value in inputs.items():
            self._set_input(node.inputs[key], value)
        return node

    def _set_input(self, socket: Socket, value: Any) -> None:
        """Link ``value`` to an input socket, or set it as the socket's default."""
        if isinstance(value, bpy.types.NodeSocket):
            self._tree.links.new(value, socket)
        elif socket.type == "RGBA":
            socket.default_value = (*value, 1.0)
        else:
            socket.default_value = value

    def position(self) -> Socket:
        """Return the shading point in the object's own frame, metres."""
        return self.node("ShaderNodeTexCoord", {}).outputs["Object"]

    def direction(self) -> Socket:
        """Return the direction of a ray that leaves the scene; only for the node tree of a world."""
        return self.node("ShaderNodeTexCoord", {}).outputs["Generated"]

    def uv(self) -> Socket:
        """Return the mesh's UV coordinates."""
        return self.node("ShaderNodeTexCoord", {}).outputs["UV"]

    def object_value(self, name: str) -> Socket:
        """Return the object's custom property ``name``."""
        node = self.node("ShaderNodeAttribute", {}, attribute_type="OBJECT", attribute_name=name)
        return node.outputs["Fac"]

    def stretched(self, position: Socket, scale: tuple[float, float, float]) -> Socket:
        """Return ``position`` scaled axis by axis."""
        return self.node("ShaderNodeMapping", {"Vector": position, "Scale": scale}).outputs["Vector"]

    def turned(self, direction: Socket, angle_rad: float) -> Socket:
        """Return ``direction`` turned about z by ``angle_rad``, counter-clockwise from above."""
        inputs: dict[str | int, Any] = {"Vector": direction, "Rotation": (0.0, 0.0, angle_rad)}
        return self.node("ShaderNodeMapping", inputs, vector_type="VECTOR").outputs["Vector"]

    def shifted(self, position: Socket, offset_m: Socket) -> Socket:
        """Return ``position`` shifted by ``offset_m`` along all three axes, to select another part of a noise."""
        return self.node("ShaderNodeVectorMath", {0: position, 1: offset_m}, operation="ADD").outputs[0]

    def wrapped(self, position: Socket, period_m: float) -> Socket:
        """Return ``position`` from the middle of its cell of a grid of cubes, whose corner is the origin."""
        half = (period_m / 2,) * 3
        inputs: dict[str | int, Any] = {0: position, 1: (period_m,) * 3, 2: (0.0,) * 3}
        cell = self.node("ShaderNodeVectorMath", inputs, operation="WRAP").outputs[0]
        return self.node("ShaderNodeVectorMath", {0: cell, 1: half}, operation="SUBTRACT").outputs[0]

    def length(self, vector: Socket) -> Socket:
        """Return the length of a vector."""
        return self.node("ShaderNodeVectorMath", {0: vector}, operation="LENGTH").outputs["Value"]

    def noise(self, position: Socket, per_metre: float, detail: float = 2.0) -> Socket:
        """Return fractal noise round 0.5 with ``per_metre`` features per metre and ``detail`` further octaves."""
        inputs: dict[str | int, Any] = {
            "Vector": position,
            "Scale": per_metre,
            "Detail": detail,
            "Roughness": 0.6,
        }
        return self.node("ShaderNodeTexNoise", inputs, noise_dimensions="3D").outputs["Fac"]

    def step(self, value: Socket, low: float, high: float) -> Socket:
        """Return a smooth step of ``value`` from 0 at ``low`` to 1 at ``high``."""
        return self.remap(value, low, high, 0.0, 1.0, "SMOOTHSTEP")

    def remap(
        self, value: Socket, low: float, high: float, to_low: float, to_high: float, interpolation: str = "LINEAR"
    ) -> Socket:
        """Return ``value`` mapped from [low, high] to [to_low, to_high], clamped."""
        inputs: dict[str | int, Any] = {0: value, 1: low, 2: high, 3: to_low, 4: to_high}
        return self.node("ShaderNodeMapRange", inputs, interpolation_type=interpolation).outputs["Result"]

    def add(self, a: Socket, b: Socket | float) -> Socket:
        """Return the sum of two values."""
        return self.node("ShaderNodeMath", {0: a, 1: b}, operation="ADD").outputs[0]

    def product(self, a: Socket, b: Socket | float) -> Socket:
        """Return the product of two values."""
        return self.node("ShaderNodeMath", {0: a, 1: b}, operation="MULTIPLY").outputs[0]

    def power(self, base: Socket, exponent: float) -> Socket:
        """Return ``base`` (not negative) to the power ``exponent``."""
        return self.node("ShaderNodeMath", {0: base, 1: exponent}, operation="POWER").outputs[0]

    def mix(self, share: Socket, a: Socket | Colour, b: Socket | Colour) -> Socket:
        """Return the colour ``a`` where ``share`` is 0 and ``b`` where it is 1."""
        # In colour mode, inputs 6 and 7 are the colours and output 2 is the result.
        inputs: dict[str | int, Any] = {0: share, 6: a, 7: b}
        return self.node("ShaderNodeMix", inputs, data_type="RGBA").outputs[2]


class WorldBuilder(NodeTreeBuilder):
    """The node tree of a new world of the open scene; ``background`` completes it."""

    def __init__(self, name: str, sampling_method: str) -> None:
        world = bpy.data.worlds.new(name)
        world.use_nodes = True
        world.cycles.sampling_method = sampling_method
        super().__init__(world.node_tree)
        bpy.context.scene.world = world

    def background(self, colour: Socket | Colour, strength: float) -> None:
        """Set the radiance of the world: ``colour`` times ``strength``."""
        inputs = self._tree.nodes["Background"].inputs
        self._set_input(inputs["Color"], colour)
        self._set_input(inputs["Strength"], strength)


class MaterialBuilder(NodeTreeBuilder):
    """The node tree of a new material, empty at first; ``matt`` or ``surface`` completes it."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        self.material.use_nodes = True
        super().__init__(self.material.node_tree)
        self._tree.nodes.clear()

    def matt(self, colour: Socket | Colour) -> bpy.types.Material:
        """Add a diffuse surface, which renders faster than ``surface``, and return the material."""
        return self._finish(self.node("ShaderNodeBsdfDiffuse", {"Color": colour}).outputs["BSDF"])

    def surface(self, **inputs: Any) -> bpy.types.Material:
        """Add a Principled surface and return the material; keywords are its inputs, with ``_`` for a space."""
        named: dict[str | int, Any] = {key.replace("_", " "): value for key, value in inputs.items()}
        return self._finish(self.node("ShaderNodeBsdfPrincipled", named).outputs["BSDF"])

    def glowing(self, colour: Socket | Colour, strength: Socket) -> bpy.types.Material:
        """Add a surface that is matt and emits ``colour`` times ``strength``, and return the material.

        Shadow rays do not seek it: scenes are lit by lamps and the sky, and it only looks lit.
        """
        diffuse = self.node("ShaderNodeBsdfDiffuse", {"Color": colour}).outputs["BSDF"]
        emission = self.node("ShaderNodeEmission", {"Color": colour, "Strength": strength}).outputs["Emission"]
        self.material.cycles.emission_sampling = "NONE"
        return self._finish(self.node("ShaderNodeAddShader", {0: diffuse, 1: emission}).outputs["Shader"])

    def _finish(self, shader: Socket) -> bpy.types.Material:
        self.node("ShaderNodeOutputMaterial", {"Surface": shader})
        return self.material
