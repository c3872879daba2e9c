"""Parts of the study of cloths that other simulators move: what it draws, what cameras see, what it counts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from diffcloud.errors import ConfigError
from diffcloud.mesh.shapes import grid_cloth
from studies import foreign as study
from tests.docs.form import check_form

CASE = study.Case("towels", 4, 40.0, True, 44.0, 35.0, 55.0, False, "identified", 20.0, "", "abc")


def lying(height=0.05, shape=(9, 7), size=(0.3, 0.4)):
    """A still level cloth about the place at which cameras look."""
    flat = grid_cloth(*shape, *size)
    nodes = flat.nodes + np.array([0.55, 0.0, height])
    return study.Moved(np.repeat(nodes[None], 2, 0), flat.faces, nodes[None, -1:].repeat(2, 0))


class TestCloths:
    def test_odd_ones_come_from_wider_ranges(self):
        narrow, wide = ([study.Cloth(seed) for seed in range(first, 400, 2)] for first in (0, 1))
        for cloths, stretching, friction in ((narrow, (8, 120), (0.2, 0.8)), (wide, (3, 2000), (0.1, 1.0))):
            values = np.array([(one.sheet.stretching, one.friction) for one in cloths])
            for column, (low, high) in zip(values.T, (stretching, friction), strict=True):
                assert low <= column.min() < low * 1.5
                assert high / 1.5 < column.max() <= high

    def test_a_seed_is_one_cloth_in_several_motions(self):
        one, other = study.Cloth(7), study.Cloth(7, motion=1)
        assert one.sheet == other.sheet == study.Cloth(7).sheet
        assert one.path != other.path
        assert not np.allclose(one.eyes, other.eyes)

    @pytest.mark.parametrize("kind", ["lift", "fold"])
    def test_the_pad_starts_at_rest_and_goes_up(self, kind):
        for seed in range(20):
            way = study.Cloth(seed, kind).path.at(np.linspace(0, 1.5, 200))[1]
            assert np.abs(way[:3]).max() < 1e-3
            assert way[:, 2].min() > -1e-6
            assert way[:, 2].max() > 0.03

    def test_a_fold_lands_on_the_cloth(self):
        for seed in range(20):
            cloth = study.Cloth(seed, "fold")
            end = cloth.path.at(np.array([1.5]))[1][0]
            assert (-np.array(cloth.size) < end[:2]).all()
            assert (end[:2] < 0).all()


class TestNewton:
    def told(self, tmp_path, monkeypatch, longer):
        """Of a strip that hangs so many times as far as a linear one, with a motion that is strained by 5 %."""
        hung = []

        def simulate(problem, settings):
            hung.append(problem)
            return problem

        def hang(sheet):
            known = real(sheet)
            return replace(known, measures=lambda track: {"elongation": 0.05 * longer})

        real = study.strip
        monkeypatch.setattr(study, "strip", hang)
        monkeypatch.setattr(study.newton, "simulate", simulate)
        cloth = study.Cloth(4)
        problem = study._problem(cloth)
        nodes = 1.05 * problem.mesh.nodes[None].repeat(2, 0)
        motion = study.Moved(nodes, problem.mesh.faces, nodes[:, cloth.held].mean(2))
        assert study._strain(cloth, motion) == pytest.approx(0.05)
        found = [study.in_a_strip(cloth, motion, tmp_path) for _ in range(2)]
        assert found[0] == found[1]
        assert len(hung) == 1  # once
        return found[0] / cloth.sheet.stretching

    def test_a_strip_that_hangs_farther_is_softer(self, tmp_path, monkeypatch):
        """Saint Venant and Kirchhoff's law stiffens: this strip would hang less far than a linear one."""
        assert self.told(tmp_path / "far", monkeypatch, 1.02) == pytest.approx(0.89, abs=0.01)  # as Newton's did
        assert self.told(tmp_path / "less", monkeypatch, 0.92) == pytest.approx(1.0, abs=0.01)  # as this simulator's did


class TestClouds:
    def test_points_lie_on_the_cloth_but_for_noise(self):
        cloth = study.Cloth(2)
        episode = study.seen(lying(), cloth, 2, cut=False)
        points = episode.frame(1)
        assert len(points) > 2000
        assert points[:, 2].std() == pytest.approx(0.002, rel=0.1)
        assert np.ptp(points[:, 0]) == pytest.approx(0.4, abs=0.03)
        assert set(episode.viewpoints) == {"camera_0", "camera_1"}

    def test_one_camera_sees_what_the_other_one_does_not(self):
        cloth = study.Cloth(2)
        both, one = (len(study.seen(lying(), cloth, count, cut=False).frame(0)) for count in (2, 1))
        assert 0 < one < both

    def test_what_lies_below_another_part_is_hidden(self):
        upper, lower = lying(0.15), lying(0.05)
        nodes = np.concatenate([upper.nodes, lower.nodes], axis=1)
        faces = np.concatenate([upper.faces, lower.faces + upper.nodes.shape[1]])
        cloth = study.Cloth(2)
        alone, under = (
            (study.seen(one, cloth, 2, cut=False).frame(0)[:, 2] < 0.1).sum()
            for one in (lower, study.Moved(nodes, faces, upper.pads))
        )
        assert under < 0.7 * alone

    def test_points_near_the_table_are_cut(self):
        cloth = study.Cloth(2)
        table = cloth.place[2]
        nodes = lying().nodes.copy()
        nodes[..., 2] = table + 0.1 * (nodes[..., 0] - nodes[..., 0].min())
        slope = replace(lying(), nodes=nodes)
        cut, whole = (study.seen(slope, cloth, 2, cut=one).frame(0)[:, 2].min() - table for one in (True, False))
        assert whole < 0.002 < 0.005 <= cut + 1e-6


class TestCounts:
    def test_an_interval_holds_what_lies_in_it(self):
        assert CASE.held
        assert not replace(CASE, truth=34.0).held
        assert not replace(CASE, truth=56.0).held
        assert replace(CASE, truth=560.0, at_upper=True).held  # it says: at least 35
        assert not replace(CASE, stated=False).held

    def test_deviations_are_those_of_the_logarithm(self):
        one = replace(CASE, truth=40.0, low=40.0, high=160.0)
        assert one.factor == pytest.approx(2.0)
        assert one.z == pytest.approx(study._Z90)
        assert replace(one, value=80.0).error == pytest.approx(np.log(2))

    def test_the_page_counts_each_set_and_all(self):
        cases = [CASE, replace(CASE, seed=5, truth=90.0), replace(CASE, set="cut", stated=False, message="no interval")]
        page = study._page(cases, 4, 2, "0123456789abcdef")
        assert "| towels | 1 of 2 |" in page
        assert "| cut | 0 of 1 |" in page
        assert "| all | 1 of 3 |" in page
        assert "| 40.0 | 44.0 | 35.0 to 55.0 | yes |" in page
        assert "no interval" in page
        assert "at commit 0123456789ab by `python -m studies foreign --sets towels,cut --seed 4 --count 2`." in page
        check_form(page)

    def test_what_is_in_the_log_is_not_fitted_again(self, tmp_path, monkeypatch):
        fitted = []

        def fit(one, seed, out, revision):
            fitted.append(seed)
            if seed == 6:
                raise ConfigError("no such towel")
            return replace(CASE, seed=seed, revision=revision)

        monkeypatch.setattr(study, "fitted", fit)
        monkeypatch.setattr(study, "_revision", lambda: "0000400000")
        words = ["--count", "3", "--out", str(tmp_path), "--jobs", "1"]
        runner, app = CliRunner(), study.app
        assert isinstance(runner.invoke(app, words).exception, ConfigError)
        assert sorted(fitted) == [4, 5, 6]  # digits of the commit
        lines = (tmp_path / "log.jsonl").read_text().splitlines()
        assert [json.loads(line)["seed"] for line in lines] == [4, 5]
        assert runner.invoke(app, [*words[2:], "--count", "2"]).exit_code == 0
        assert sorted(fitted) == [4, 5, 6]

    def test_an_unknown_set_is_refused(self, tmp_path):
        told = CliRunner().invoke(study.app, ["--sets", "socks", "--out", str(tmp_path)])
        assert told.exit_code != 0
        assert "socks" in str(told.exception or told.output)
