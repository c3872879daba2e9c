"""Every integrator by name, and one of a stranger, with what the protocol asks for and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pydantic import TypeAdapter, ValidationError

from diffcloud.errors import DivergedError, SceneError
from diffcloud.mesh import grid_cloth
from diffcloud.scene import Scene
from diffcloud.sim.handles import Handles
from diffcloud.sim.integrators import INTEGRATORS, Integrator, IntegratorName, Outcome, load_integrator
from diffcloud.sim.materials import isotropic
from diffcloud.sim.simulate import init, rollout
from diffcloud.sim.status import DONE, FIRST_OWN
from diffcloud.sim.surrounding import ContactSettings, ReferenceContact, Surrounding


class Falling:
    """Nodes fall and meet nothing, until one is below the floor at z = -1 m."""

    name = "falling"
    terms = ()
    contacts = ()
    smooth = True
    meshes = True

    def check(self, surrounding):
        if surrounding.obstacles:
            raise SceneError("What falls meets no obstacles.")

    def with_contact(self, surrounding):
        return surrounding

    def resting_height(self, contact, weight):
        return 0.0

    def build(self, setup, time_step):
        return np.array(setup.surrounding.gravity), time_step, len(setup.mesh.nodes)

    def points(self, scene):
        return scene[2]

    def simulate(self, scene, episode, keep, control):
        gravity, step, _ = scene
        x, v = episode.positions, episode.velocities
        for s in range(len(x) - 1):
            v[s + 1] = v[s] + step * gravity
            x[s + 1] = x[s] + step * v[s + 1]
            if x[s + 1, :, 2].min() < -1.0:
                return Outcome(FIRST_OWN, s, None)
            control[0] += 1
        return Outcome(DONE, len(x) - 1, None)

    def reverse(self, scene, episode, outcome, gradients):
        for s in range(len(episode.positions) - 2, -1, -1):
            gradients.positions[s] += gradients.positions[s + 1]
            gradients.velocities[s] += gradients.velocities[s + 1] + scene[1] * gradients.positions[s + 1]

    def tangents(self, scene, episode, outcome, rates):
        raise NotImplementedError

    def energy(self, scene, parameters, positions):
        return 0.0

    def fault(self, entry, episode, outcome):
        return DivergedError(outcome.step + 1, [entry], "a node is below the floor")


INTEGRATOR = Falling()


@pytest.fixture
def falling(monkeypatch):
    """A scene with that integrator, registered by its one line."""
    monkeypatch.setitem(INTEGRATORS, "falling", __name__)
    sheet = isotropic("any", density=0.2, stretching=50.0, bending=1e-5)
    yield Scene(grid_cloth(3, 3, 0.1, 0.1), sheet, Handles(()), frame_time=0.01).stepped("falling")
    load_integrator.cache_clear()


@pytest.mark.parametrize("name", INTEGRATORS)
class TestEveryIntegrator:
    def test_it_has_what_the_simulation_asks_for(self, name):
        found = load_integrator(name)
        assert isinstance(found, Integrator)
        assert found.name == TypeAdapter(IntegratorName).validate_python(name) == name
        assert {term.name for term in found.terms}.isdisjoint(term.name for term in found.contacts)

    def test_its_own_contact_passes_its_check(self, name):
        for given in (None, ReferenceContact()):
            own = load_integrator(name).with_contact(Surrounding(reference_contact=given))
            load_integrator(name).check(own)
            assert load_integrator(name).with_contact(own) == own

    def test_what_weighs_more_rests_lower_within_the_thickness(self, name):
        contact = ContactSettings()
        heights = [load_integrator(name).resting_height(contact, weight) for weight in (0.1, 1.0, 5.0)]
        assert contact.repulsion_thickness > heights[0] > heights[1] > heights[2] > 0.0


def test_no_such_integrator():
    with pytest.raises(SceneError, match=r"Unknown integrator 'implict'. Did you mean 'implicit'"):
        load_integrator("implict")
    with pytest.raises(ValidationError, match="Unknown integrator 'linearised'"):
        TypeAdapter(IntegratorName).validate_python("linearised")


class TestAStrangersIntegrator:
    def test_it_simulates_and_has_gradients(self, falling):
        system, _ = falling.build()
        assert isinstance(system.integrator, Integrator)
        start = torch.as_tensor(system.mesh.nodes, dtype=torch.float64)[None].requires_grad_()
        velocities = torch.zeros_like(start).requires_grad_()
        run = rollout(system, 4, state=init(system, positions=start, velocities=velocities))
        assert run.positions[0, -1, :, 2].tolist() == pytest.approx([-9.81 * 1e-4 * (1 + 2 + 3 + 4)] * 9)
        run.positions[:, -1].sum().backward()
        assert torch.equal(start.grad, torch.ones_like(start))
        torch.testing.assert_close(velocities.grad, torch.full_like(start, 0.04))

    def test_its_faults_are_told(self, falling):
        system, _ = falling.build()
        with pytest.raises(DivergedError, match=r"step 45, .*: a node is below the floor"):
            rollout(system, 60)

    def test_it_refuses_what_it_cannot_simulate(self, falling):
        around = Surrounding(obstacles=(object(),))
        with pytest.raises(SceneError, match="meets no obstacles"):
            load_integrator("falling").check(around)
