"""How fast pictures are on an NVIDIA GPU: python scripts/gpu_frames.py demo/avatar.safetensors.

Every picture has a new pose between the flat hand and the fist, 512 x 512, one ray a pixel. By
kernel: the time of a picture, its difference from torch's operations on the same samples, and how
much of the chip's measured peak the pair decoder reaches. The time is the median of some rounds
through the poses, after one that is not timed. The first run compiles for half a minute.
"""

import math
import statistics
import sys
import time

import torch

import handavatar.field.fused as fused
from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.evaluate.speed_table import hand_camera
from handavatar.field.kernels import Kernel
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import gesture_rotations

KERNELS: tuple[Kernel, ...] = ("triton-bf16", "triton-tf32", "triton", "torch")
SIZE, PICTURES, ROUNDS, COMPARED = 512, 16, 5, (0.1, 0.5, 0.9)
# Operations of an item (trunk) and of an answer: every product of the kernels, two each.
ITEM = 2 * 2 * (4 * 192 + 128 * 64 + 64 * 64) + 2 * 2 * (2 * 64 * 64 + 6 * 64 * 64)
ANSWER = 2 * (5 * 64 * 64 + 4 * 64 * 128 + 128 * 128 + 128)

device = torch.device("cuda")
avatar = HandAvatar.load(sys.argv[1]).moved_to(device)
flat, fist = (gesture_rotations(avatar.base_rig, name).to(device) for name in ("flat", "fist"))


def bent(share: float) -> HandPose:
    """Between flat and fist."""
    return HandPose(torch.lerp(flat, fist, share), flat.new_zeros(3))


def now() -> float:
    """Seconds, once the GPU has done all that it was asked."""
    torch.cuda.synchronize()
    return time.perf_counter()


def pictures(kernel: Kernel) -> list[torch.Tensor]:
    """In the poses that are compared."""
    settings = RenderSettings(edge_rays=1, kernel=kernel)
    return [avatar.render(bent(share), camera, settings=settings).color for share in COMPARED]


def decoding(kernel: Kernel) -> tuple[float, float]:
    """Seconds and operations of the pair decoder in one picture."""
    seconds, operations, decode = 0.0, 0, fused._decode

    def watched(*arguments: object) -> None:
        nonlocal seconds, operations
        begin = now()
        decode(*arguments)  # type: ignore[arg-type]
        seconds += now() - begin
        items = arguments[3]
        assert isinstance(items, fused._Items)
        operations += ITEM * len(items.points) + ANSWER * len(items.answers)

    fused._decode = watched
    try:
        avatar.render(bent(0.3), camera, settings=RenderSettings(edge_rays=1, kernel=kernel))
    finally:
        fused._decode = decode
    return seconds, operations


with torch.no_grad():
    vertices = avatar.prepare(bent(0)).posed.vertices
camera = hand_camera(vertices, (0.0, -1.0, 0.0), SIZE).to(device)
matrix = torch.randn(8192, 8192, device=device, dtype=torch.bfloat16)
matrix @ matrix
begin = now()
for _ in range(5):
    matrix @ matrix
peak = 5 * 2 * 8192**3 / (now() - begin)
print(f"{torch.cuda.get_device_name()}, {peak / 1e12:.0f} TFLOP/s in a product of bf16 matrices")
truth = pictures("torch")
for kernel in KERNELS:
    errors = [found - true for found, true in zip(pictures(kernel), truth, strict=True)]
    mean = torch.stack(errors).square().mean().item()
    largest = max(float(error.abs().max()) for error in errors)
    settings = RenderSettings(edge_rays=1, kernel=kernel)
    torch.cuda.reset_peak_memory_stats()
    rounds = []
    # Torch's operations take minutes.
    for _ in range(2 if kernel == "torch" else ROUNDS + 1):
        begin = now()
        for number in range(PICTURES):
            avatar.render(bent((number + 0.5) / PICTURES), camera, settings=settings)
        rounds.append((now() - begin) / PICTURES)
    spent = statistics.median(rounds[1:])
    told = ", ".join(f"{1e3 * each:.1f}" for each in rounds)
    print(
        f"{kernel}: {1e3 * spent:.1f} ms ({told}), {1 / spent:.1f} a second, "
        f"{torch.cuda.max_memory_allocated() / 1e9:.2f} GB, "
        f"{-10 * math.log10(max(mean, 1e-20)):.0f} dB, {largest:.1e} at most"
    )
    if kernel != "torch":
        seconds, operations = decoding(kernel)
        print(
            f"  decoder: {1e3 * seconds:.1f} ms, {operations / 1e12:.2f} TFLOP, "
            f"{operations / seconds / 1e12:.0f} TFLOP/s, {100 * operations / seconds / peak:.0f} %"
        )
