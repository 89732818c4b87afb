"""Learn a camera's noise as a function of the brightness, through the estimator, with PyTorch.

The same as `with_jax.py`: a small network gives the variance of each measurement, and
`Estimates` tells PyTorch the derivatives of the estimates, those of `mhe.sensitivity()`. PyTorch is
no dependency of qpmhe: ``pip install torch``.
"""

import argparse

import camera
import numpy as np
import torch


class Estimates(torch.autograd.Function):
    """The estimates (T, 2), for variances (T,) of the noise: ``Estimates.apply(Y, variances)``."""

    @staticmethod
    def forward(ctx, measurements, variances):
        """The estimates, and their slopes for later."""
        states, slopes = camera.estimate_and_slopes(
            measurements.detach().numpy(), variances.detach().numpy()
        )
        ctx.save_for_backward(torch.from_numpy(slopes))
        return torch.from_numpy(states)

    @staticmethod
    def backward(ctx, cotangents):
        """The derivatives by the variances; the measurements are no parameters."""
        (slopes,) = ctx.saved_tensors
        found = camera.pulled_back(cotangents.numpy(), slopes.numpy())
        return None, torch.from_numpy(found)


class Network(torch.nn.Module):
    """The variance for each brightness: one hidden layer, positive by its exponential."""

    def __init__(self, hidden=8):
        super().__init__()
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(1, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, 1)
        ).double()
        with torch.no_grad():
            self.layers[0].weight.normal_(std=4.0)
            self.layers[0].bias.normal_()
            self.layers[2].weight *= 0.0
            self.layers[2].bias[:] = np.log(0.1**2)

    def forward(self, brightness):
        """The variances (T,)."""
        return torch.exp(self.layers(brightness[:, None])[:, 0])


class Constant(torch.nn.Module):
    """One variance for all pictures."""

    def __init__(self):
        super().__init__()
        self.logarithm = torch.nn.Parameter(torch.tensor(np.log(0.1**2)))

    def forward(self, brightness):
        """The variances (T,)."""
        return torch.exp(self.logarithm) * torch.ones_like(brightness)


def loss(model, records):
    """The mean square error of the estimates, in standard deviations of the disturbance."""
    scale = torch.from_numpy(camera.DISTURBANCE)
    errors = [
        (Estimates.apply(Y, model(light)) - X[1:]) / scale for X, Y, light in records
    ]
    return torch.stack([one.square().mean() for one in errors]).mean()


def train(model, records, steps):
    optimiser = torch.optim.Adam(model.parameters(), lr=0.1, betas=(0.9, 0.99))
    for k in range(1, steps + 1):
        optimiser.zero_grad()
        value = loss(model, records)
        value.backward()
        optimiser.step()
        if k == 1 or k % 20 == 0:
            print(f"  step {k:3d}: loss {value.item():.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=60, help="steps of Adam")
    parser.add_argument("--records", type=int, default=3, help="records to learn from")
    parser.add_argument("--tests", type=int, default=20, help="records to judge by")
    options = parser.parse_args()
    torch.manual_seed(0)
    records = [
        tuple(map(torch.from_numpy, camera.record(seed))) for seed in range(options.records)
    ]
    tests = [camera.record(1000 + seed) for seed in range(options.tests)]

    def errors(variance):
        return [camera.estimate(Y, variance(light)) - X[1:] for X, Y, light in tests]

    rows = []
    for name, model in (
        ("one learnt constant", Constant()), ("learnt from the brightness", Network())
    ):
        print(name)
        train(model, records, options.steps)
        rows.append((name, errors(lambda s, m=model: m(torch.from_numpy(s)).detach().numpy())))
    rows.append(("true", errors(lambda s: camera.deviation(s) ** 2)))
    print(f"\nErrors on {options.tests} other records, RMS:\n")
    print(camera.table(rows))


if __name__ == "__main__":
    main()
