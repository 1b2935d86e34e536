"""Painted skin: a procedural albedo texture in the rig's own texture chart.

Everything is decided per texel from where it lies on the template hand (position, normal, bone
frames), so that there are no seams and any rig with joint axes and a chart will do. The same
options and seed give the same subject; another seed gives another one. Lengths in this module are
millimetres. Texture row ``i`` and column ``j`` of ``n`` lie at ``v = (i + 0.5) / n`` and
``u = (j + 0.5) / n``.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.pose import FINGER_BONES
from handavatar.hand.rig import Rig

# sRGB colours of the back of the hand and of the palm from light to dark; palms and nail beds
# carry little melanin, so they darken far less.
_TONES = np.array([0.0, 0.35, 0.65, 1.0])
_BACK_COLORS = np.array([[235, 196, 172], [205, 153, 121], [152, 103, 76], [84, 54, 41]]) / 255
_PALM_COLORS = np.array([[236, 188, 168], [216, 163, 137], [188, 137, 112], [146, 101, 82]]) / 255
_NAIL_COLORS = np.array([[238, 196, 184], [224, 176, 160], [205, 155, 137], [172, 122, 106]]) / 255

# Palm lines as control points (x, z) in the plane of the palm of a hand whose middle finger's
# knuckle is 93 mm from the wrist: fingers along -x, thumb side +z.
_PALM_REFERENCE = 93.0
_PALM_LINES = (
    ((-56, -46), (-62, -30), (-70, -14), (-82, 0), (-91, 12)),
    ((-75, 40), (-68, 24), (-58, 8), (-48, -10), (-40, -26)),
    ((-76, 40), (-68, 26), (-52, 14), (-32, 7), (-12, 10)),
)


@dataclass(frozen=True)
class SkinOptions:
    """What a subject's skin looks like."""

    seed: int = 0
    """another seed, another subject: line courses, veins, spots, mottling"""
    tone: float = 0.35
    """0 very light to 1 very dark"""
    redness: float = 1.0
    """strength of the blood in knuckles, finger pads and palm"""
    lines: float = 1.0
    """strength of wrinkles, creases and palm lines"""
    veins: float = 1.0
    """strength of the veins on the back of the hand"""
    mottling: float = 1.0
    """strength of the fine irregular colour"""
    num_spots: int = 14
    """moles and freckles on the back of the hand"""


@dataclass(frozen=True, eq=False)
class ChartTexels:
    """Where the texels of a square texture lie on a mesh.

    Attributes:
        is_inside: texels whose centre lies in a triangle of the chart.
        faces: the triangle of each of those, in row order.
        barycentric: and the place in it.
    """

    is_inside: Bool[np.ndarray, "rows columns"]
    faces: Int64[np.ndarray, "texels"]
    barycentric: Float64[np.ndarray, "texels 3"]


def chart_texels(rig: Rig, resolution: int) -> ChartTexels:
    """Rasterises the rig's texture chart."""
    corners = rig.uv_coordinates[rig.uv_faces].double().numpy() * resolution
    owner = np.full((resolution, resolution), -1, dtype=np.int64)
    weights = np.zeros((resolution, resolution, 3))
    for face, (a, b, c) in enumerate(corners):
        low = np.floor(np.minimum(np.minimum(a, b), c) - 0.5).astype(int).clip(0)
        high = np.ceil(np.maximum(np.maximum(a, b), c) + 0.5).astype(int).clip(max=resolution)
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-12 or (high <= low).any():
            continue
        x = np.arange(low[0], high[0])[None, :] + 0.5
        y = np.arange(low[1], high[1])[:, None] + 0.5
        of_b = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        of_c = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        local = np.stack([1 - of_b - of_c, of_b, of_c], axis=-1)
        covers = (local >= -1e-9).all(-1)
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        owner[window][covers] = face
        weights[window][covers] = local[covers]
    inside = owner >= 0
    return ChartTexels(inside, owner[inside], weights[inside])


def paint_skin(
    rig: Rig, options: SkinOptions, resolution: int = 1024
) -> Float[Tensor, "resolution resolution 3"]:
    """The albedo texture of a subject.

    Args:
        rig: needs a texture chart and joint axes; nails are painted where it names their vertices.
        options: the subject.
        resolution: texels along each side; a hand needs about 1024 for its wrinkles.

    Returns:
        Colours as stored, sRGB in [0, 1]. Texels outside the chart repeat the nearest one inside.
    """
    texels = chart_texels(rig, resolution)
    colors = _Painter(rig, options, texels).colors()
    texture = np.zeros((resolution, resolution, 3))
    texture[texels.is_inside] = colors
    nearest = ndimage.distance_transform_edt(
        ~texels.is_inside, return_distances=False, return_indices=True
    )
    return torch.from_numpy(texture[tuple(nearest)]).float()


def smooth_noise(
    points: Float64[np.ndarray, "points 3"],
    wavelength: Float64[np.ndarray, "3"],
    random: np.random.Generator,
) -> Float64[np.ndarray, "points"]:
    """Smooth random values over space, mean 0, mostly within -1 and 1 (deviation about 0.56).

    Args:
        points: where.
        wavelength: distance between independent values along x, y and z, in the points' unit.
        random: draws the values.
    """
    cells = points / wavelength
    cells = cells - cells.min(0) + 2
    grid = random.standard_normal(np.ceil(cells.max(0)).astype(int) + 3)
    return 1.7 * ndimage.map_coordinates(grid, cells.T, order=3, prefilter=False)


class _Painter:
    """Layers of paint over the texels, each a function of the place on the template hand."""

    def __init__(self, rig: Rig, options: SkinOptions, texels: ChartTexels) -> None:
        self.rig, self.options = rig, options
        self.random = np.random.default_rng([options.seed, 20230])
        corners = rig.faces.numpy()[texels.faces]

        def at_texels(values: Tensor) -> np.ndarray:
            per_corner = values.double().numpy()[corners]
            return np.einsum("tk,tk...->t...", texels.barycentric, per_corner)

        self.places = at_texels(rig.template_vertices) * 1000
        self.normals = _unit(at_texels(vertex_normals(rig.template_vertices, rig.faces)))
        weights = at_texels(rig.skin_weights)
        self.joints = rig.shaped().rest_joints.double().numpy() * 1000
        self.axes = rig.joint_axes.double().numpy()
        dorsal = self.axes[:, 1].copy()
        dorsal[0] = (0, 1, 0)
        self.dorsal = (_unit(weights @ dorsal) * self.normals).sum(-1)
        self.is_back = _step(self.dorsal, -0.15, 0.35)
        self.bone = weights.argmax(-1)
        self.scale = float(np.linalg.norm(self.joints[4])) / _PALM_REFERENCE

    def colors(self) -> np.ndarray:
        options = self.options
        tone = options.tone
        back, palm = (_of_tone(colors, tone) for colors in (_BACK_COLORS, _PALM_COLORS))
        blend = self.is_back[:, None]
        color = palm * (1 - blend) + back * blend
        # Paint multiplies: pigment absorbs. Blood takes green and blue, pigment more of blue.
        blood = options.redness * self.blood() + options.mottling * (
            0.35 * self.noise(7.0) + 0.3 * self.noise(2.6)
        ) * (1.15 - 0.45 * self.is_back)
        pigment = options.mottling * (0.5 * self.noise(15.0) + 0.45 * self.noise(1.4))
        pigment = pigment + self.knuckle_pigment() * tone + 2.2 * self.spots()
        lines = options.lines * (self.wrinkles() + self.creases() + self.palm_lines())
        strength = 0.75 + 0.5 * (1 - tone)
        color = color * np.exp(
            -blood[:, None] * np.array([-0.035, 0.085, 0.065]) * strength
            - pigment[:, None] * np.array([0.09, 0.13, 0.16])
            - lines.clip(0, 1.6)[:, None] * np.array([0.30, 0.42, 0.42])
            - options.veins * self.veins()[:, None] * np.array([0.13, 0.06, 0.02])
        )
        return self.nails(color).clip(0.01, 0.99)

    def noise(
        self, wavelength: float, stretch: tuple[float, float, float] = (1, 1, 1)
    ) -> np.ndarray:
        return smooth_noise(self.places, wavelength * np.array(stretch), self.random)

    def along(self, bone: int) -> tuple[np.ndarray, np.ndarray]:
        """Millimetres from a joint along its bone, and across it."""
        offset = self.places - self.joints[bone]
        return offset @ self.axes[bone, 2], offset @ self.axes[bone, 0]

    def of_finger(self, bones: tuple[int, ...]) -> np.ndarray:
        return np.isin(self.bone, bones)

    def bone_length(self, bone: int, following: int | None) -> float:
        """To the next joint, or to the tip."""
        if following is not None:
            return float(np.linalg.norm(self.joints[following] - self.joints[bone]))
        along, _ = self.along(bone)
        return float(along[self.bone == bone].max())

    def tip(self, bone: int) -> np.ndarray:
        return self.joints[bone] + self.axes[bone, 2] * self.bone_length(bone, None)

    def bump(self, center: np.ndarray, radius: float) -> np.ndarray:
        """Gaussian of the distance to a point."""
        squared = ((self.places - center) ** 2).sum(-1)
        return np.exp(-0.5 * squared / radius**2)

    def blood(self) -> np.ndarray:
        """Knuckles on the back; pads, tips and the balls of the thumb and little finger below."""
        front = 1 - self.is_back
        total = 0.3 * self.noise(22.0) * front
        for finger, (first, second, third) in FINGER_BONES.items():
            size = 1.25 if finger == "thumb" else 1.0
            for bone, radius, weight in ((first, 6.5, 1.2), (second, 6.0, 1.5), (third, 5.0, 0.9)):
                if finger == "thumb" and bone == first:
                    continue
                weight *= 0.7 + 0.6 * self.random.random()
                total = total + weight * self.is_back * self.bump(self.joints[bone], radius * size)
            total = total + 1.4 * self.bump(self.tip(third), 8.0 * size)
            pad = (self.joints[second] + self.joints[third]) / 2
            total = total + 0.5 * front * self.bump(pad, 9.0 * size)
        x = self.scale
        for center, radius, weight in (
            ((-40, -25, 34), 14.0, 1.0),
            ((-42, -22, -32), 14.0, 1.1),
            ((-80, -18, 0), 16.0, 0.5),
        ):
            total = total + weight * front * self.bump(
                x * np.array(center, float), float(x * radius)
            )
        return total

    def knuckle_pigment(self) -> np.ndarray:
        total = np.zeros(len(self.places))
        for first, second, third in FINGER_BONES.values():
            for bone, radius in ((first, 7.0), (second, 6.0), (third, 4.5)):
                total += self.is_back * self.bump(self.joints[bone], radius)
        return 1.5 * total

    def wrinkles(self) -> np.ndarray:
        """Bands across the back of the middle and last finger joints."""
        total = np.zeros(len(self.places))
        course, broken = self.noise(5.0), self.noise(3.0)
        for finger, (_, second, third) in FINGER_BONES.items():
            for bone, bands, reach in ((second, 5, 5.0), (third, 3, 2.6)):
                along, across = self.along(bone)
                near = self.of_finger(FINGER_BONES[finger]) * _step(self.dorsal, 0.15, 0.6)
                near = near * np.exp(-0.5 * (across / 5.5) ** 2)
                for place in np.linspace(-reach, reach, bands):
                    place = place + self.random.normal(0, 0.4)
                    depth = (0.55 + 0.35 * self.random.random()) * (1.1 - 0.1 * abs(place))
                    # Bands bow away from the joint, towards the sides of the finger.
                    bow = place * (1 + 0.35 * (across / 6) ** 2) + 0.45 * course
                    band = np.exp(-0.5 * ((along - bow) / 0.45) ** 2)
                    total += depth * near * band * _step(broken, -1.6, -0.2)
        return total

    def creases(self) -> np.ndarray:
        """Folds on the palm side: one at the last joint, two at the middle one, two at the base."""
        total = np.zeros(len(self.places))
        course = self.noise(6.0)
        for finger, (first, second, third) in FINGER_BONES.items():
            base = 0.0 if finger == "thumb" else 0.52 * self.bone_length(first, second)
            folds = [(third, 0.0, 0.95), (second, -0.9, 1.0), (second, 1.0, 0.7)]
            if finger != "thumb":
                folds += [(first, base, 0.9), (first, base - 2.2, 0.45)]
            for bone, place, depth in folds:
                along, _ = self.along(bone)
                place = place + self.random.normal(0, 0.3)
                fold = np.exp(-0.5 * ((along - place - 0.4 * course) / 0.55) ** 2)
                front = self.of_finger(FINGER_BONES[finger]) * _step(-self.dorsal, 0.0, 0.45)
                total += depth * front * fold
        for place, depth in ((2.0, 0.7), (-2.5, 0.5)):
            fold = np.exp(-0.5 * ((self.places[:, 0] - place - 1.2 * course) / 0.6) ** 2)
            total += depth * fold * _step(-self.dorsal, 0.1, 0.5)
        return total

    def palm_lines(self) -> np.ndarray:
        """Heart, head and life line, and a few faint minor ones."""
        total = np.zeros(len(self.places))
        front = _step(-self.dorsal, 0.1, 0.5) * ~self.of_finger((2, 3, 5, 6, 8, 9, 11, 12, 14, 15))
        course = 0.3 * self.noise(4.0)
        width = (0.6 + 0.16 * self.noise(6.0)).clip(0.35)
        plane = self.places[:, [0, 2]] / self.scale
        lines = [(np.array(line, float), 1.05) for line in _PALM_LINES]
        for _ in range(7):
            start = self.random.uniform((-80, -34), (-22, 22))
            course_end = start + self.random.normal((-10, 0), 9)
            lines.append((np.linspace(start, course_end, 3), 0.35))
        reached = front > 0
        for points, depth in lines:
            points = points + self.random.normal(0, 1.6, points.shape)
            curve = _spline(points, 400)
            distance, nearest = cKDTree(curve).query(plane[reached])
            fade = np.sin(np.pi * np.clip(nearest / 399, 0.06, 0.94)) ** 0.4
            line = np.exp(-0.5 * ((distance + course[reached]) / width[reached]) ** 2)
            total[reached] = np.maximum(total[reached], depth * fade * line * front[reached])
        return total

    def veins(self) -> np.ndarray:
        """Where stretched noise passes zero, soft, on the back of the hand between the tendons."""
        course = self.noise(12.0, (3.5, 1.0, 1.0)) + 0.3 * self.noise(8.0)
        vein = np.exp(-0.5 * (course / 0.17) ** 2) * _step(self.noise(25.0), -1.2, 0.4)
        back = _step(self.dorsal, 0.35, 0.8) * np.isin(self.bone, (0, 1, 4, 7, 10))
        from_wrist = -self.places[:, 0] / self.scale
        return vein * back * _step(from_wrist, -5.0, 15.0) * _step(-from_wrist, -95.0, -70.0)

    def spots(self) -> np.ndarray:
        total = np.zeros(len(self.places))
        candidates = np.flatnonzero(self.is_back > 0.8)
        for place in self.random.choice(candidates, self.options.num_spots):
            strength, radius = self.random.uniform(0.3, 1.2), self.random.uniform(0.5, 1.1)
            total += strength * self.bump(self.places[place], radius)
        return total

    def nails(self, color: np.ndarray) -> np.ndarray:
        """Nail plates with a pale lunula, a white edge and a dark fold around them."""
        plate = _of_tone(_NAIL_COLORS, self.options.tone)
        skin_fold = 0.62
        for finger, bones in FINGER_BONES.items():
            members = self.rig.vertex_sets.get(f"nail_{finger}")
            if members is None or len(members) < 3:
                continue
            corners = self.rig.template_vertices[members].double().numpy() * 1000
            along, across = self.axes[bones[2], 2], self.axes[bones[2], 0]
            offset = self.places - corners.mean(0)
            own = corners - corners.mean(0)
            middle = ((own @ along).max() + (own @ along).min()) / 2
            half_length = max(((own @ along).max() - (own @ along).min()) / 2, 3.0)
            half_width = max(np.abs(own @ across).max(), 3.0)
            u = (offset @ along - middle) / half_length
            v = (offset @ across) / half_width
            # Squarer towards the tip, rounder at the root.
            power = np.where(u > 0, 4.0, 2.4)
            radius = (np.abs(u) ** power + np.abs(v) ** power) ** (1 / power)
            facing = self.of_finger(bones[1:]) * _step(self.dorsal, 0.05, 0.25)
            is_nail = _step(-radius, -1.04, -0.96) * facing
            fold = np.exp(-0.5 * ((radius - 1.06) / 0.055) ** 2) * facing * (u < 0.8)
            lunula = _step(-np.hypot((u + 1.0) / 0.42, v / 0.55), -1.05, -0.9)
            edge = _step(u, 0.80, 0.87)
            pale = plate + (0.97 - plate) * (0.38 * lunula + 0.55 * edge)[:, None]
            pale = pale * (1 + 0.012 * self.noise(2.0) + 0.03 * (1 - v**2).clip(0))[:, None]
            color = color * (1 - (1 - skin_fold) * fold)[:, None]
            color = color * (1 - is_nail[:, None]) + pale * is_nail[:, None]
        return color


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True).clip(1e-12)


def _step(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smooth step from 0 at ``low`` to 1 at ``high``."""
    share = ((values - low) / (high - low)).clip(0, 1)
    return share * share * (3 - 2 * share)


def _of_tone(colors: np.ndarray, tone: float) -> np.ndarray:
    return np.array([np.interp(tone, _TONES, channel) for channel in colors.T])


def _spline(points: np.ndarray, count: int) -> np.ndarray:
    """Points along a smooth curve through control points (Catmull-Rom)."""
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    time = np.linspace(0, len(points) - 1 - 1e-9, count)
    index, t = time.astype(int), (time % 1)[:, None]
    a, b, c, d = (padded[index + k] for k in range(4))
    return 0.5 * (
        2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * (b - c) + d - a) * t**3
    )
