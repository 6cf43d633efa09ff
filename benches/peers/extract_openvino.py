"""The backbone up to the exit block in OpenVINO and ONNX Runtime, on the same weights and input as ours.

Builds the truncated graph (tokens and CLS attention of one block, nothing later) from the safetensors that
`placeformer model pull` stores, and times it. Results are checked against each other before anything is timed.

    pip install -r benches/peers/requirements.txt
    python benches/peers/extract_openvino.py MODEL.safetensors [--size 448x336] [--exit-block 8] [--threads 2] [--int8]

Prints one JSON object: milliseconds per image by engine and batch, median and least, and the CPU time of all threads,
which a busy machine disturbs least.
"""

import argparse
import json

import numpy as np
import onnx
import onnxruntime
import openvino
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import load_file
from timing import measure

HEADS, PATCH = 6, 14


class Graph:
    """Collects nodes and initializers, naming every output by its place."""

    def __init__(self):
        self.nodes, self.constants = [], []

    def constant(self, value):
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def integers(self, *values):
        return self.constant(np.array(values, np.int64))

    def add(self, kind, *inputs, output=None, **attributes):
        output = output or f"{kind}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output


def build(weights, columns, rows, exit_block):
    """The graph `pixels [N, 3, H, W] -> tokens [N, 1+n, d], attention [N, heads, n]` for a fixed grid."""
    graph, dim = Graph(), weights["cls_token"].shape[-1]
    split, merge = graph.integers(0, -1, HEADS, dim // HEADS), graph.integers(0, -1, dim)

    def linear(x, name):
        product = graph.add("MatMul", x, graph.constant(weights[f"{name}.weight"].T))
        return graph.add("Add", product, graph.constant(weights[f"{name}.bias"]))

    def norm(x, name):
        scale, shift = (graph.constant(weights[f"{name}.{part}"]) for part in ("weight", "bias"))
        return graph.add("LayerNormalization", x, scale, shift, axis=-1, epsilon=1e-6)

    # What the values of the positions are does not matter for time, and the exact interpolation is ours to get right.
    positions = weights["pos_embed"][:, : 1 + columns * rows]
    patches = graph.add(
        "Conv",
        "pixels",
        graph.constant(weights["patch_embed.proj.weight"]),
        graph.constant(weights["patch_embed.proj.bias"]),
        strides=[PATCH, PATCH],
        kernel_shape=[PATCH, PATCH],
    )
    patches = graph.add("Reshape", patches, graph.integers(0, dim, columns * rows))
    patches = graph.add("Transpose", patches, perm=[0, 2, 1])
    patches = graph.add("Add", patches, graph.constant(positions[:, 1:]))
    ones = graph.add("Slice", patches, graph.integers(0), graph.integers(1), graph.integers(1))
    zeros = graph.add("Mul", ones, graph.constant(np.zeros(1, np.float32)))
    cls = graph.add("Add", zeros, graph.constant(weights["cls_token"] + positions[:, :1]))
    x = graph.add("Concat", cls, patches, axis=1)

    for block in range(exit_block + 1):
        base = f"blocks.{block}"
        fused = linear(norm(x, f"{base}.norm1"), f"{base}.attn.qkv")
        parts = [f"{base}.{part}" for part in "qkv"]
        graph.nodes.append(helper.make_node("Split", [fused], parts, axis=-1, num_outputs=3))
        query, key, value = (
            graph.add("Transpose", graph.add("Reshape", part, split), perm=[0, 2, 3, 1] if i == 1 else [0, 2, 1, 3])
            for i, part in enumerate(parts)
        )
        query = graph.add("Mul", query, graph.constant(np.float32((dim // HEADS) ** -0.5)))
        weight = graph.add("Softmax", graph.add("MatMul", query, key), axis=-1)
        if block == exit_block:
            starts, ends, axes = graph.integers(0, 1), graph.integers(1, 1 << 30), graph.integers(2, 3)
            row = graph.add("Slice", weight, starts, ends, axes)
            graph.add("Squeeze", row, graph.integers(2), output="attention")
        mixed = graph.add("Transpose", graph.add("MatMul", weight, value), perm=[0, 2, 1, 3])
        mixed = linear(graph.add("Reshape", mixed, merge), f"{base}.attn.proj")
        x = graph.add("Add", x, graph.add("Mul", mixed, graph.constant(weights[f"{base}.ls1.gamma"])))
        hidden = graph.add("Gelu", linear(norm(x, f"{base}.norm2"), f"{base}.mlp.fc1"), approximate="none")
        scaled = graph.add("Mul", linear(hidden, f"{base}.mlp.fc2"), graph.constant(weights[f"{base}.ls2.gamma"]))
        output = "tokens" if block == exit_block else None
        x = graph.add("Add", x, scaled, output=output)

    floats = lambda name, *shape: helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
    n = columns * rows
    body = helper.make_graph(
        graph.nodes,
        "backbone",
        [floats("pixels", "N", 3, rows * PATCH, columns * PATCH)],
        [floats("tokens", "N", 1 + n, dim), floats("attention", "N", HEADS, n)],
        graph.constants,
    )
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    onnx.checker.check_model(model)
    return model


def fused_names(weights):
    """The weights under timm's names, whichever of the two namings they came in."""
    if "cls_token" in weights:
        return weights
    renamed = {
        "cls_token": weights["embeddings.cls_token"],
        "pos_embed": weights["embeddings.position_embeddings"],
        "patch_embed.proj.weight": weights["embeddings.patch_embeddings.projection.weight"],
        "patch_embed.proj.bias": weights["embeddings.patch_embeddings.projection.bias"],
    }
    for block in range(12):
        old, new = f"encoder.layer.{block}", f"blocks.{block}"
        for part in ("weight", "bias"):
            query, key, value = (weights[f"{old}.attention.attention.{n}.{part}"] for n in ("query", "key", "value"))
            renamed[f"{new}.attn.qkv.{part}"] = np.concatenate([query, key, value])
            renamed[f"{new}.attn.proj.{part}"] = weights[f"{old}.attention.output.dense.{part}"]
            for name in ("norm1", "norm2", "mlp.fc1", "mlp.fc2"):
                renamed[f"{new}.{name}.{part}"] = weights[f"{old}.{name}.{part}"]
        for scale in (1, 2):
            renamed[f"{new}.ls{scale}.gamma"] = weights[f"{old}.layer_scale{scale}.lambda1"]
    return renamed


def openvino_runner(model, threads, precision, calibration=None):
    """A function from pixels to outputs; quantised to int8 with the images of `calibration` if there are any."""
    core = openvino.Core()
    options = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": precision, "PERFORMANCE_HINT": "LATENCY"}
    network = core.read_model(model.SerializeToString(), b"")
    if calibration is not None:
        import nncf

        images = nncf.Dataset([image[None] for image in calibration])
        network = nncf.quantize(network, images, model_type=nncf.ModelType.TRANSFORMER, subset_size=len(calibration))
    compiled = core.compile_model(network, "CPU", options)
    request = compiled.create_infer_request()
    return lambda pixels: [value.copy() for value in request.infer({0: pixels}).values()]


def onnxruntime_runner(model, threads):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    return lambda pixels: session.run(None, {"pixels": pixels})


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("--size", default="448x336")
    parser.add_argument("--exit-block", type=int, default=8)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repetitions", type=int, default=11)
    parser.add_argument("--int8", action="store_true", help="also quantised by NNCF (takes a minute)")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8])
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    model = build(fused_names(load_file(arguments.weights)), width // PATCH, height // PATCH, arguments.exit_block)
    pixels = np.random.default_rng(1).standard_normal((max(arguments.batches), 3, height, width)).astype(np.float32)
    runners = {
        "openvino-f32": openvino_runner(model, arguments.threads, "f32"),
        "onnxruntime-f32": onnxruntime_runner(model, arguments.threads),
    }
    tokens = [run(pixels[:1])[0] for run in runners.values()]
    difference = float(np.abs(tokens[0] - tokens[1]).max())
    assert difference < 1e-2, f"the engines disagree by {difference}"
    # The tolerance above does not apply to less exact ones.
    runners["openvino-bf16"] = openvino_runner(model, arguments.threads, "bf16")
    if arguments.int8:
        runners["openvino-int8"] = openvino_runner(model, arguments.threads, "bf16", pixels)
    results = {
        f"{name}-batch{batch}": measure(run, pixels[:batch], arguments.repetitions)
        for name, run in runners.items()
        for batch in arguments.batches
    }
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
