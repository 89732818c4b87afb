"""The models with a stated region: an observer whose proved bound is smaller than the region."""

import numpy as np
import pytest

import qpmhe
from qpmhe.certificates.contraction import certify_detectability, certify_observer
from qpmhe.certificates.evidence import CertificateError, Evidence, NotCertifiedError
from qpmhe.certificates.observer_bound import ObserverBound
from qpmhe.certificates.report import _proved_observer, region_of, sizes_of
from qpmhe.certificates.sdp import started

OWN = {"batch_reactor", "pendulum"}
STATED = {*OWN, "van_der_pol", "cstr", "battery_cell", "vehicle"}


@pytest.mark.parametrize("name", sorted(qpmhe.models.catalogue()))
def test_bound_is_smaller_than_the_region(name):
    system, observer, cost, scenario = qpmhe.models.catalogue()[name]()
    assert (scenario.region is not None) == (name in STATED)
    if name not in STATED:
        return
    region, sizes = region_of(system, scenario), sizes_of(system, cost, scenario)
    assert region.contains(scenario.initial_state)
    proved, stability, replaced = _proved_observer(system, observer, region, sizes, started(300.0))
    assert (proved is observer) is (name in OWN)
    assert ("in place of the model's own" in replaced) is (name not in OWN)
    bound = ObserverBound(stability, region, sizes)
    assert bound.evidence is Evidence.PROVED
    assert (bound.components(bound.limit()) < (region.upper - region.lower)[: system.n]).all()


def test_angles_are_certified_where_they_do_not_wrap():
    system = qpmhe.models.vehicle()[0]
    inputs = qpmhe.Box([0.0, -1.5], [2.0, 1.5])
    observer = qpmhe.Luenberger([
        [-0.4, -0.4, -0.5, 0.5], [0.75, -0.8, -0.1, -0.1], [-0.05, 0.05, -0.35, -0.4],
    ])
    place = qpmhe.Box([-1.0, -1.0, -0.2], [1.0, 1.0, 0.2])
    found = certify_observer(
        system, observer, place, inputs=inputs, sizes=([0.06] * 3, [0.6, 0.6, 0.15, 0.15])
    )
    assert found.evidence is Evidence.PROVED
    # Half a turn, less twice 0.2 of the heading and what the bearing moves by.
    note = next(each for each in found.notes if "y[2]" in each)
    room = float(note.split("less than ")[1].split(":")[0])
    rng = np.random.default_rng(4)
    x = rng.uniform(place.lower, place.upper, (2000, 3))
    bearings = system.h.batch(x, np.zeros((2000, 2)))[:, 2]
    assert np.ptp(bearings) + room <= np.pi
    assert np.ptp(bearings) + room > np.pi - 0.3
    with pytest.raises(NotCertifiedError, match=r"angle y\[2\] may wrap"):
        certify_observer(
            system, observer, place, inputs=inputs, sizes=([0.06] * 3, [0.6, 0.6, 3.0, 0.15])
        )
    with pytest.raises(CertificateError, match="the system has angles"):
        certify_detectability(system, place, inputs=inputs)
