"""Record what the authors' published DISTS and LPIPS make of seeded images, with random or trained weights.

The package and its tests hold no PyTorch; this script does, in an environment of its own:

    python -m venv torchenv
    torchenv/bin/pip install torch==2.13.0 torchvision==0.28.0 lpips==0.1.4 DISTS-pytorch==0.1
    torchenv/bin/python experiments/references/perceptual.py tests/data/perceptual/reference.npz
    torchenv/bin/python experiments/references/perceptual.py tests/data/perceptual/trained.npz WEIGHTS

The networks are torchvision's, the measures those of the packages ``lpips`` and ``DISTS_pytorch``, in
double precision. Images are drawn by numpy, here and in the tests, by the functions below, and so are the
weights of the first file, which holds a checksum of the draws beside scores, gradients seen along four
directions, and means of features. The second has the scores of ten pairs with the trained weights:
convolutions from the folder WEIGHTS that ``envedit weights`` makes, all else from the authors' packages.
"""

import os
import sys
import zlib

import numpy as np

CHANNELS = {
    "vgg": (64, 128, 256, 512, 512),
    "alex": (64, 192, 384, 256, 256),
}
CASES = (
    ("dists", "vgg", (24, 40)),
    ("dists", "vgg", (33, 47)),
    ("dists", "vgg", (5, 3)),
    ("lpips", "vgg", (33, 47)),
    ("lpips", "alex", (47, 61)),
)
DIRECTIONS = 4
SEEDS = {"alex": 0, "vgg": 2}


def shapes(kind):
    """Shapes of the convolutions of a network (O, I, k, k), by torchvision's names."""
    if kind == "vgg":
        widths = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
        places = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
        found = {i: (o, n, 3, 3) for i, n, o in zip(places, widths[:-1], widths[1:], strict=True)}
    else:
        found = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3)}
        found[10] = (256, 256, 3, 3)
    return {f"features.{i}": shape for i, shape in found.items()}


def tensors(kind):
    """Draw the weights of a network: a float32 state dict whose layers keep the size of what goes through."""
    rng = np.random.default_rng(SEEDS[kind])
    found = {}
    for name, shape in shapes(kind).items():
        weight = rng.standard_normal(shape, np.float32) * np.float32((2 / np.prod(shape[1:])) ** 0.5)
        found[name + ".weight"] = weight
        found[name + ".bias"] = rng.uniform(-0.1, 0.1, shape[0]).astype(np.float32)
    return found


def heads(kind):
    """Draw the heads of LPIPS, float32 (1, C, 1, 1)."""
    rng = np.random.default_rng(100)
    return {
        f"lin{i}.model.1.weight": rng.random((1, c, 1, 1), np.float32) for i, c in enumerate(CHANNELS[kind])
    }


def alpha_beta():
    """Draw the weights of DISTS, float32 (1, 1475, 1, 1)."""
    rng = np.random.default_rng(200)
    return {name: rng.random((1, 3 + sum(CHANNELS["vgg"]), 1, 1), np.float32) for name in ("alpha", "beta")}


def images(height, width):
    """Make two images in [0, 1] that resemble each other, and directions in which gradients are seen."""
    rng = np.random.default_rng(1000 * height + width)
    r, c = np.mgrid[:height, :width]
    y = np.stack([0.5 + 0.3 * np.sin(0.31 * r + 0.17 * k * c) * np.cos(0.05 * k * c) for k in (1, 2, 3)], -1)
    y = np.clip(y + 0.1 * rng.standard_normal(y.shape), 0, 1)
    x = np.clip(0.7 * np.roll(y, 2, axis=1) + 0.2 * y + 0.1 * rng.random(y.shape), 0, 1)
    return x, y, rng.standard_normal((DIRECTIONS, *y.shape))


def pairs():
    """Make ten pairs of images, from all but the same to as unlike as those of :func:`images`."""
    for k in range(10):
        x, y, _ = images(*((40, 64), (52, 39))[k % 2])
        share = 0.05 * 20 ** (k / 9)
        yield share * x + (1 - share) * y, y


def checksum(drawn):
    """CRC of arrays: whether numpy draws the same ones as when the file was recorded."""
    crc = 0
    for values in drawn:
        crc = zlib.crc32(np.ascontiguousarray(values), crc)
    return np.uint32(crc)


def trained(path, folder):
    """Record LPIPS (AlexNet, VGG16) and DISTS of :func:`pairs`, with trained weights."""
    import lpips
    import torch
    import torchvision
    from DISTS_pytorch import DISTS

    def features(kind):
        name = {"alex": "alexnet", "vgg": "vgg16"}[kind]
        model = getattr(torchvision.models, name)(weights=None)
        with np.load(os.path.join(folder, f"{name}_features.npz")) as file:
            found = {key.removeprefix("features."): torch.tensor(file[key]) for key in file.files}
        model.features.load_state_dict(found)
        return model

    def with_network(kind, make):
        """Let a package make its measure with this network where it asks torchvision for the trained one."""
        name = {"alex": "alexnet", "vgg": "vgg16"}[kind]
        model = features(kind)
        asked = getattr(torchvision.models, name)
        setattr(torchvision.models, name, lambda *_, **__: model)
        try:
            return make().double().eval()
        finally:
            setattr(torchvision.models, name, asked)

    alex = with_network("alex", lambda: lpips.LPIPS(net="alex", verbose=False))
    vgg = with_network("vgg", lambda: lpips.LPIPS(net="vgg", verbose=False))
    dists = with_network("vgg", DISTS)
    scores = []
    drawn = []
    with torch.no_grad():
        for x, y in pairs():
            drawn += [x, y]
            a, b = (torch.tensor(one.transpose(2, 0, 1)[None]) for one in (x, y))
            found = alex(a, b, normalize=True), vgg(a, b, normalize=True), dists(a, b)
            scores.append([float(one) for one in found])
            print(*scores[-1])
    np.savez_compressed(path, images=checksum(drawn), scores=np.array(scores))


def main(path):
    import lpips
    import torch
    import torchvision
    from DISTS_pytorch import DISTS

    def image(values):
        return torch.tensor(values.transpose(2, 0, 1)[None])

    def network():
        model = torchvision.models.vgg16(weights=None)
        model.load_state_dict({k: torch.tensor(v) for k, v in tensors("vgg").items()}, strict=False)
        return model

    def make_dists():
        made, torchvision.models.vgg16 = torchvision.models.vgg16, lambda pretrained: loaded
        measure = DISTS(load_weights=False).double()
        torchvision.models.vgg16 = made
        for name, value in alpha_beta().items():
            getattr(measure, name).data = torch.tensor(value).double()
        # The packages round these to single precision.
        measure.mean = torch.tensor([[[[0.485]], [[0.456]], [[0.406]]]], dtype=torch.float64)
        measure.std = torch.tensor([[[[0.229]], [[0.224]], [[0.225]]]], dtype=torch.float64)
        return lambda x, y: measure(x, y, require_grad=True), lambda x: measure.forward_once(x)[1:]

    def make_lpips(kind):
        measure = lpips.LPIPS(net=kind, pretrained=False, pnet_rand=True, verbose=False).double()
        drawn = tensors(kind)
        with torch.no_grad():
            for name, parameter in measure.net.named_parameters():
                parameter.copy_(torch.tensor(drawn["features." + name.split(".", 1)[1]]))
            for name, value in heads(kind).items():
                measure.get_parameter(name).copy_(torch.tensor(value))
        scaling = measure.scaling_layer
        scaling.shift = torch.tensor([[[[-0.030]], [[-0.088]], [[-0.188]]]], dtype=torch.float64)
        scaling.scale = torch.tensor([[[[0.458]], [[0.448]], [[0.450]]]], dtype=torch.float64)
        return lambda x, y: measure(x, y, normalize=True), lambda x: measure.net(scaling(2 * x - 1))

    loaded = network()
    record = {"weights": checksum(v for kind in sorted(CHANNELS) for v in tensors(kind).values())}
    for name, kind, size in CASES:
        x, y, directions = images(*size)
        measure, features = make_dists() if name == "dists" else make_lpips(kind)
        leaf = image(x).requires_grad_()
        score = measure(leaf, image(y)).squeeze()
        score.backward()
        gradient = leaf.grad[0].numpy().transpose(1, 2, 0)
        taps = [tap.detach()[0] for tap in features(image(x))]
        case = f"{name}_{kind}_{size[0]}x{size[1]}"
        record[case + "/images"] = checksum((x, y, directions))
        record[case + "/score"] = np.float64(score.item())
        record[case + "/slopes"] = np.tensordot(directions, gradient, 3)
        record[case + "/length"] = np.linalg.norm(gradient)
        record[case + "/means"] = np.array([tap.mean().item() for tap in taps])
        record[case + "/squares"] = np.array([tap.square().mean().item() for tap in taps])
        print(case, record[case + "/score"])
    np.savez_compressed(path, **record)
    print(f"torch {torch.__version__}, torchvision {torchvision.__version__}: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) == 2 else trained(*sys.argv[1:])
