"""Nonlinear regressions of NIST's Statistical Reference Datasets, with their certified parameters.

Source: https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml (public domain), as copied in
https://github.com/lmfit/lmfit-py, NIST_STRD. Of three levels of difficulty, those with at most 54
measurements. ``start`` is far from the certified parameters, ``near`` is nearer.
"""

from typing import NamedTuple

import numpy as np

import qpmhe

exp = np.exp
# Parameters b and the predictor x: arrays that broadcast.
MODELS = {
    "Misra1a": lambda b, x: b[0] * (1 - exp(-b[1] * x)),
    # b0 (1 - (1 + b1 x / 2)^-2), without cancellation.
    "Misra1b": lambda b, x: b[0] * (b[1] * x / 2) * (2 + b[1] * x / 2) / (1 + b[1] * x / 2) ** 2,
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Chwirut2": lambda b, x: exp(-b[0] * x) / (b[1] + b[2] * x),
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "Lanczos2": lambda b, x: sum(b[k] * exp(-b[k + 1] * x) for k in (0, 2, 4)),
    "MGH17": lambda b, x: b[0] + b[1] * exp(-x * b[3]) + b[2] * exp(-x * b[4]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / np.pi,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "Thurber": lambda b, x: (
        (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)
    ),
    "BoxBOD": lambda b, x: b[0] * (1 - exp(-b[1] * x)),
    "Rat42": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "MGH10": lambda b, x: b[0] * exp(b[1] / (x + b[2])),
    "Eckerle4": lambda b, x: b[0] / b[1] * exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
}
MODELS["Lanczos3"] = MODELS["Lanczos2"]
# Terms that may change places: the parameters of each, the last of which is sorted by.
ALIKE = {"MGH17": [(1, 3), (2, 4)], "Lanczos2": [(0, 1), (2, 3), (4, 5)]}
ALIKE["Lanczos3"] = ALIKE["Lanczos2"]
# Deviations of the prior, in the larger of start and solution: it says nothing.
VAGUE = 1e5

DATA = """\
Misra1a
start 500 0.0001
near 250 0.0005
certified 238.94212918 0.00055015643181
deviations 2.7070075241 7.2668688436e-06
rss 0.12455138894
x 77.6 114.9 141.1 190.8 239.9 289 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760
y 10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.4 75.47 81.78

Misra1b
start 500 0.0001
near 300 0.0002
certified 337.99746163 0.00039039091287
deviations 3.1643950207 4.2547321834e-06
rss 0.075464681533
x 77.6 114.9 141.1 190.8 239.9 289 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760
y 10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.4 75.47 81.78

Misra1c
start 500 0.0001
near 600 0.0002
certified 636.42725809 0.00020813627256
deviations 4.6638326572 1.7728423155e-06
rss 0.040966836971
x 77.6 114.9 141.1 190.8 239.9 289 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760
y 10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.4 75.47 81.78

Misra1d
start 500 0.0001
near 450 0.0003
certified 437.36970754 0.00030227324449
deviations 3.6489174345 2.9334354479e-06
rss 0.056419295283
x 77.6 114.9 141.1 190.8 239.9 289 332.8 378.4 434.8 477.3 536.8 593.1 689.1 760
y 10.07 14.73 17.94 23.93 29.61 35.18 40.02 44.82 50.76 55.05 61.01 66.4 75.47 81.78

Chwirut2
start 0.1 0.01 0.02
near 0.15 0.008 0.01
certified 0.16657666537 0.0051653291286 0.012150007096
deviations 0.03830328681 0.00066621605126 0.0015304234767
rss 513.04802941
x 0.5 1 1.75 3.75 5.75 0.875 2.25 3.25 5.25 0.75 1.75 2.75 4.75 0.625 1.25 2.25 4.25 0.5 3 0.75 3
  1.5 6 3 6 1.5 3 0.5 2 4 0.75 2 5 0.75 2.25 3.75 5.75 3 0.75 2.5 4 0.75 2.5 4 0.75 2.5 4 0.5 6 3
  0.5 2.75 0.5 1.75
y 92.9 57.1 31.05 11.5875 8.025 63.6 21.4 14.25 8.475 63.8 26.8 16.4625 7.125 67.3 41 21.15 8.175
  81.5 13.12 59.9 14.62 32.9 5.44 12.56 5.44 32 13.95 75.8 20 10.42 59.5 21.67 8.55 62 20.2 7.76
  3.75 11.81 54.7 23.7 11.55 61.3 17.7 8.74 59.2 16.3 8.62 81 4.87 14.62 81.7 17.17 81.3 28.9

DanWood
start 1 5
near 0.7 4
certified 0.76886226176 3.8604055871
deviations 0.01828197386 0.051726610913
rss 0.0043173084083
x 1.309 1.471 1.49 1.565 1.611 1.68
y 2.138 3.421 3.597 4.34 4.882 5.66

Lanczos2
start 1.2 0.3 5.6 5.5 6.5 7.6
near 0.5 0.7 3.6 4.2 4 6.3
certified 0.096251029939 1.0057332849 0.86424689056 3.0078283915 1.5529016879 5.00287981
deviations 0.00066770575477 0.0033989646176 0.0017185846685 0.0041707005856 0.0023744381417
  0.0013958787284
rss 2.2299428125e-11
x 0 0.05 0.1 0.15 0.2 0.25 0.3 0.35 0.4 0.45 0.5 0.55 0.6 0.65 0.7 0.75 0.8 0.85 0.9 0.95 1 1.05
  1.1 1.15
y 2.5134 2.04433 1.6684 1.36642 1.12323 0.92689 0.767934 0.638878 0.533784 0.447936 0.377585
  0.319739 0.272013 0.232497 0.199659 0.17227 0.149341 0.13007 0.113812 0.100042 0.0883321
  0.0783354 0.0697669 0.0623931

Lanczos3
start 1.2 0.3 5.6 5.5 6.5 7.6
near 0.5 0.7 3.6 4.2 4 6.3
certified 0.086816414977 0.95498101505 0.84400777463 2.9515951832 1.5825685901 4.9863565084
deviations 0.017197908859 0.097041624475 0.041488663282 0.10766312506 0.058371576281 0.034436403035
rss 1.6117193594e-08
x 0 0.05 0.1 0.15 0.2 0.25 0.3 0.35 0.4 0.45 0.5 0.55 0.6 0.65 0.7 0.75 0.8 0.85 0.9 0.95 1 1.05
  1.1 1.15
y 2.5134 2.0443 1.6684 1.3664 1.1232 0.9269 0.7679 0.6389 0.5338 0.4479 0.3776 0.3197 0.272 0.2325
  0.1997 0.1723 0.1493 0.1301 0.1138 0.1 0.0883 0.0783 0.0698 0.0624

MGH17
start 50 150 -100 1 2
near 0.5 1.5 -1 0.01 0.02
certified 0.37541005211 1.9358469127 -1.4646871366 0.01286753464 0.022122699662
deviations 0.0020723153551 0.22031669222 0.22175707739 0.00044861358114 0.00089471996575
rss 5.4648946975e-05
x 0 10 20 30 40 50 60 70 80 90 100 110 120 130 140 150 160 170 180 190 200 210 220 230 240 250 260
  270 280 290 300 310 320
y 0.844 0.908 0.932 0.936 0.925 0.908 0.881 0.85 0.818 0.784 0.751 0.718 0.685 0.658 0.628 0.603
  0.58 0.558 0.538 0.522 0.506 0.49 0.478 0.467 0.457 0.448 0.438 0.431 0.424 0.42 0.414 0.411
  0.406

Roszman1
start 0.1 -1e-05 1000 -100
near 0.2 -5e-06 1200 -150
certified 0.20196866396 -6.1953516256e-06 1204.4556708 -181.34269537
deviations 0.019172666023 3.2058931691e-06 74.050983057 49.573513849
rss 0.00049484847331
x -4868.68 -4868.09 -4867.41 -3375.19 -3373.14 -3372.03 -2473.74 -2472.35 -2469.45 -1894.65 -1893.4
  -1497.24 -1495.85 -1493.41 -1208.68 -1206.18 -1206.04 -997.92 -996.61 -996.31 -834.94 -834.66
  -710.03 -530.16 -464.17
y 0.252429 0.252141 0.251809 0.297989 0.296257 0.295319 0.339603 0.337731 0.33382 0.38951 0.386998
  0.438864 0.434887 0.427893 0.471568 0.461699 0.461144 0.513532 0.506641 0.505062 0.535648
  0.533726 0.568064 0.612886 0.624169

MGH09
start 25 39 41.5 39
near 0.25 0.39 0.415 0.39
certified 0.19280693458 0.19128232873 0.12305650693 0.13606233068
deviations 0.011435312227 0.19633220911 0.080842031232 0.090025542308
rss 0.00030750560385
x 4 2 1 0.5 0.25 0.167 0.125 0.1 0.0833 0.0714 0.0625
y 0.1957 0.1947 0.1735 0.16 0.0844 0.0627 0.0456 0.0342 0.0323 0.0235 0.0246

Thurber
start 1000 1000 400 40 0.7 0.3 0.03
near 1300 1500 500 75 1 0.4 0.05
certified 1288.13968 1491.0792535 583.23836877 75.416644291 0.96629502864 0.39797285797
  0.049727297349
deviations 4.6647963344 39.571156086 28.698696102 5.567537027 0.031333340687 0.014984928198
  0.0065842344623
rss 5642.7082397
x -3.067 -2.981 -2.921 -2.912 -2.84 -2.797 -2.702 -2.699 -2.633 -2.481 -2.363 -2.322 -1.501 -1.46
  -1.274 -1.212 -1.1 -1.046 -0.915 -0.714 -0.566 -0.545 -0.4 -0.309 -0.109 -0.103 0.01 0.119 0.377
  0.79 0.963 1.006 1.115 1.572 1.841 2.047 2.2
y 80.574 84.248 87.264 87.195 89.076 89.608 89.868 90.101 92.405 95.854 100.696 101.06 401.672
  390.724 567.534 635.316 733.054 759.087 894.206 990.785 1090.109 1080.914 1122.643 1178.351
  1260.531 1273.514 1288.339 1327.543 1353.863 1414.509 1425.208 1421.384 1442.962 1464.35 1468.705
  1447.894 1457.628

BoxBOD
start 1 1
near 100 0.75
certified 213.80940889 0.54723748542
deviations 12.354515176 0.10455993237
rss 1168.0088766
x 1 2 3 5 7 10
y 109 149 149 191 213 224

Rat42
start 100 1 0.1
near 75 2.5 0.07
certified 72.462237576 2.6180768402 0.067359200066
deviations 1.7340283401 0.088295217536 0.0034465663377
rss 8.0565229338
x 9 14 21 28 42 57 63 70 79
y 8.93 10.8 18.59 22.33 39.35 56.11 61.73 64.62 67.08

Rat43
start 100 10 1 1
near 700 5 0.75 1.3
certified 699.6415127 5.2771253025 0.75962938329 1.2792483859
deviations 16.302297817 2.0828735829 0.19566123451 0.68761936385
rss 8786.404908
x 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15
y 16.08 33.83 65.8 97.2 191.55 326.2 386.87 520.53 590.03 651.92 724.93 699.56 689.96 637.56 717.41

MGH10
start 2 400000 25000
near 0.02 4000 250
certified 0.005609636471 6181.3463463 345.22363462
deviations 0.00015687892471 23.309021107 0.78486103508
rss 87.945855171
x 50 55 60 65 70 75 80 85 90 95 100 105 110 115 120 125
y 34780 28610 23650 19630 16370 13720 11540 9744 8261 7030 6005 5147 4427 3820 3307 2872

Eckerle4
start 1 10 500
near 1.5 5 450
certified 1.5543827178 4.0888321754 451.54121844
deviations 0.015408051163 0.046803020753 0.046800518816
rss 0.0014635887487
x 400 405 410 415 420 425 430 435 436.5 438 439.5 441 442.5 444 445.5 447 448.5 450 451.5 453 454.5
  456 457.5 459 460.5 462 463.5 465 470 475 480 485 490 495 500
y 0.0001575 0.0001699 0.000235 0.0003102 0.0004917 0.000871 0.0017418 0.00464 0.0065895 0.0097302
  0.0149002 0.023731 0.0401683 0.0712559 0.1264458 0.2073413 0.2902366 0.3445623 0.3698049
  0.3668534 0.3106727 0.2078154 0.1164354 0.0616764 0.03372 0.0194023 0.0117831 0.0074357 0.0022732
  0.00088 0.0004579 0.0002345 0.0001586 0.0001143 7.1e-05
"""


class Regression(NamedTuple):
    """A data set; deviations are those of the certified parameters, sigma that of the noise."""

    name: str
    start: np.ndarray
    near: np.ndarray
    certified: np.ndarray
    deviations: np.ndarray
    x: np.ndarray
    y: np.ndarray
    sigma: float

    def prior(self, start):
        """Standard deviations of the prior."""
        return VAGUE * np.maximum(np.abs(start), np.abs(self.certified))

    def residuals(self, b, start):
        """What J is the sum of the squares of."""
        misfit = (MODELS[self.name](b, self.x) - self.y) / self.sigma
        return np.append(misfit, (b - start) / self.prior(start))

    def jacobian(self, b, start):
        """Of the residuals, by the complex step."""
        steps = b + 1e-40j * np.diag(np.abs(b) + (b == 0))
        columns = [self.residuals(one, start).imag / one.imag.max() for one in steps]
        return np.stack(columns, axis=1)

    def missed(self, b):
        """The largest miss of a certified parameter, in 1e-6 of it or 1e-4 of its deviation.

        The latter changes J by 1e-8; rounding hides changes below 1e-12 of J.
        """
        b, pairs = np.array(b), ALIKE.get(self.name, [])
        order = sorted(pairs, key=lambda pair: b[pair[-1]])
        known = sorted(pairs, key=lambda pair: self.certified[pair[-1]])
        b[[j for pair in known for j in pair]] = b[[j for pair in order for j in pair]]
        unit = np.maximum(1e-6 * np.abs(self.certified), 1e-4 * self.deviations)
        return float(np.max(np.abs(b - self.certified) / unit))

    def estimator(self, start, form, max_qps, engine, backend="auto"):
        """Constant parameters as states, fitted to a window of all measurements.

        With a wide form, the states have bounds that are far away.
        """
        k, f = len(start), MODELS[self.name]

        def h(b, u):
            return f([b[..., j] for j in range(k)], u[..., 0])[..., None]

        options, disturbance = {}, np.eye(k)
        if form.startswith("wide"):
            options["states"] = qpmhe.Box(-1e3 * self.prior(start), 1e3 * self.prior(start))
        if form.endswith("set"):
            options["disturbances"] = qpmhe.Box(np.zeros(k), np.zeros(k))
        else:  # a thousandth of the certified deviations in the whole window
            disturbance = np.diag((1e-3 * self.deviations) ** 2 / len(self.y))
        return qpmhe.MovingHorizonEstimator(
            qpmhe.System(lambda b, u: b, h, n=k, p=1, m=1, **options),
            qpmhe.Luenberger(np.zeros((k, 1))),
            qpmhe.QuadraticCost.from_covariances(
                prior=np.diag(self.prior(start) ** 2), disturbance=disturbance,
                noise=[[self.sigma**2]],
            ),
            horizon=len(self.y), initial_state=start, max_qps=max_qps, tolerance=1e-13,
            engine=engine, backend=backend,
        )

    def fit(self, start, form, max_qps, engine, backend="auto"):
        """The estimate after the last measurement; without QPs before it."""
        samples = [*zip(self.y[:, None], self.x[:, None], strict=True)]
        before = self.estimator(start, form, 0, engine)
        for y, u in samples[:-1]:
            before.update(y, u)
        mhe = self.estimator(start, form, max_qps, engine, backend)
        mhe.load_state_dict(before.state_dict())
        return mhe.update(*samples[-1])


def regression(name):
    """The data set of a name."""
    block = next(one for one in DATA.split("\n\n") if one.split()[0] == name)
    numbers, key = {}, ""
    for word in block.split()[1:]:
        if word.isalpha():
            key = word
            numbers[key] = []
        else:
            numbers[key].append(float(word))
    found = {key: np.array(one) for key, one in numbers.items()}
    rss = float(found.pop("rss")[0])
    freedom = len(found["y"]) - len(found["certified"])
    return Regression(name, **found, sigma=(rss / freedom) ** 0.5)
