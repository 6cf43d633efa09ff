"""The whole backbone, all twelve blocks, in PyTorch: what users run today who do not cut it.

Same weights, same input size. bf16 is autocast, attention is PyTorch's own fused one. PyTorch is not among the
requirements of the other peers, because its wheel brings several gigabytes of CUDA with it.

    pip install torch==2.15.0 numpy safetensors
    python benches/peers/extract_torch.py MODEL.safetensors [--size 448x336] [--blocks 12] [--threads 2]

Prints one JSON object: milliseconds per image by precision and batch, median and least, and the CPU time of all
threads.
"""

import argparse
import json

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from timing import measure

HEADS, PATCH = 6, 14


class Backbone:
    """A ViT over weights under the hub's names."""

    def __init__(self, weights, columns, rows, blocks):
        self.weights, self.blocks = weights, blocks
        # What the values of the positions are does not matter for time.
        self.positions = weights["embeddings.position_embeddings"][:, : 1 + columns * rows]

    def linear(self, x, name):
        return F.linear(x, self.weights[f"{name}.weight"], self.weights[f"{name}.bias"])

    def norm(self, x, name):
        return F.layer_norm(x, x.shape[-1:], self.weights[f"{name}.weight"], self.weights[f"{name}.bias"], 1e-6)

    def __call__(self, pixels):
        base = "embeddings.patch_embeddings.projection"
        x = F.conv2d(pixels, self.weights[f"{base}.weight"], self.weights[f"{base}.bias"], stride=PATCH)
        x = x.flatten(2).transpose(1, 2)
        cls = self.weights["embeddings.cls_token"].expand(len(x), -1, -1)
        x = torch.cat([cls, x], 1) + self.positions
        for block in range(self.blocks):
            base = f"encoder.layer.{block}"
            normed = self.norm(x, f"{base}.norm1")
            query, key, value = (
                self.linear(normed, f"{base}.attention.attention.{part}").unflatten(-1, (HEADS, -1)).transpose(1, 2)
                for part in ("query", "key", "value")
            )
            mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
            mixed = self.linear(mixed, f"{base}.attention.output.dense")
            x = x + mixed * self.weights[f"{base}.layer_scale1.lambda1"]
            hidden = F.gelu(self.linear(self.norm(x, f"{base}.norm2"), f"{base}.mlp.fc1"))
            x = x + self.linear(hidden, f"{base}.mlp.fc2") * self.weights[f"{base}.layer_scale2.lambda1"]
        return x


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("--size", default="448x336")
    parser.add_argument("--blocks", type=int, default=12)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repetitions", type=int, default=11)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8])
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(1)
    width, height = map(int, arguments.size.split("x"))
    backbone = Backbone(load_file(arguments.weights), width // PATCH, height // PATCH, arguments.blocks)
    pixels = torch.randn(max(arguments.batches), 3, height, width)

    @torch.inference_mode()
    def bf16(pixels):
        with torch.autocast("cpu", torch.bfloat16):
            return backbone(pixels)

    runners = {"torch-f32": torch.inference_mode()(backbone.__call__), "torch-bf16": bf16}
    exact, rounded = (run(pixels[:1]).float().flatten() for run in runners.values())
    cosine = F.cosine_similarity(exact, rounded, 0).item()
    assert cosine > 0.99, f"bf16 and f32 disagree: cosine {cosine}"
    results = {
        f"{name}-batch{batch}": measure(run, pixels[:batch], arguments.repetitions)
        for name, run in runners.items()
        for batch in arguments.batches
    }
    print(json.dumps({"torch": torch.__version__, **results}, indent=1))


if __name__ == "__main__":
    main()
