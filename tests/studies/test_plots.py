# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the pictures of a study against its numbers: percent, intervals, the paper's points, axes and their units."""

import pytest
from matplotlib.collections import LineCollection

from torchrl_koap.studies import plots
from torchrl_koap.studies.plots import method_styles, plot_average, plot_measure
from torchrl_koap.studies.table import Measure, Summary


@pytest.fixture
def figures(monkeypatch):
    """What is drawn, instead of a file."""
    made = []
    monkeypatch.setattr(plots, "save_figure", lambda figure, path: made.append(figure))
    return made


def summary(method, labels, mean, *, demonstrations=1.0, **more):
    """A method whose success, or each further measure, is ``mean``, from 0.1 below to 0.2 above."""
    measures = {name: Measure(mean, mean - 0.1, mean + 0.2) for name in more.pop("names", ("success",))}
    measures |= {name: Measure(value, value, value) for name, value in more.items()}
    return Summary("avoiding", method, labels, demonstrations, "window", (0,), (), (), 20, measures)


def points(line):
    return [(round(x, 6), round(y, 6)) for x, y in zip(line.get_xdata(), line.get_ydata(), strict=True)]


def names(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_success_in_percent_with_its_interval_and_the_paper_s_points(figures):
    items = [summary("koap", 0.1, 0.7), summary("koap", 0.02, 0.5)]
    plot_measure(items, "x.png", paper={"koap": [(0.1, 0.9), (0.01, 0.8)], "vae": [(0.1, 0.2)]})
    (axes,) = figures[0].axes
    own, paper = axes.lines
    assert points(own) == [(0.02, 50), (0.1, 70)]  # in the order of the axis
    assert points(paper) == [(0.01, 80), (0.1, 90)] and paper.get_markerfacecolor() == "white"
    (band,) = axes.collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((40, 90))
    assert axes.get_ylim() == (-3, 103) and axes.get_ylabel() == "success (%)"
    assert axes.get_title(loc="left").startswith("success, 95 % interval\nhollow")
    assert axes.get_xlim()[0] < 0.01 and [axes.xaxis.get_major_formatter()(x, 0) for x in (0.01, 0.1)] == [
        "1 %",
        "10 %",
    ]


def test_many_methods_have_whiskers(figures):
    items = [summary(method, labels, 0.6) for method in "abcd" for labels in (0.02, 0.1)]
    plot_measure(items, "x.png")
    (axes,) = figures[0].axes
    assert all(isinstance(item, LineCollection) for item in axes.collections)
    (first, _) = axes.collections[0].get_segments()
    assert first.ravel().tolist() == pytest.approx([0.02, 50, 0.02, 80]) and names(figures[0]) == [*"abcd"]


def test_methods_keep_their_colours_where_one_is_missing(figures):
    plot_measure([summary("vae", 0.02, 0.6), summary("vae", 0.1, 0.6)], "x.png", methods=["koap", "ridge", "vae"])
    assert figures[0].axes[0].lines[0].get_color() == method_styles(["koap", "ridge", "vae"])["vae"]["color"]


def test_panels_name_their_units(figures):
    items = [summary("koap", share, 0.6, labelled_transitions=9000 * share) for share in (0.02, 0.1)]
    plot_measure(items, "x.png", by=("labels", "labelled_transitions"), label_unit="of windows")
    left, right = figures[0].axes
    assert (left.get_xlabel(), right.get_xlabel()) == ("labelled share (of windows)", "distinct labelled transitions")
    assert points(right.lines[0]) == [(180, 60), (900, 60)]
    assert right.xaxis.get_major_formatter()(9000, 0) == "9,000" and right.get_ylabel() == ""


def test_the_mean_action_is_a_line_among_relative_errors_alone(figures):
    for measure in ("relative_action_error", "action_error", "mode_entropy"):
        items = [summary("koap", share, 0.6, names=[measure]) for share in (0.02, 0.1)]
        plot_measure(items, "x.png", measure, unit="mm" if measure == "action_error" else "")
    relative, error, entropy = (figure.axes[0] for figure in figures)
    assert points(relative.lines[0]) == [(0.02, 0.6), (0.1, 0.6)] and relative.lines[-1].get_ydata() == [1, 1]
    assert len(error.lines) == 1 and error.get_ylabel() == "action error (mm)"
    assert entropy.get_ylim() == pytest.approx((-0.03, 1.03))


def test_by_demonstrations_every_share_of_labels_has_a_line(figures):
    items = [summary("koap", labels, 0.6, demonstrations=used) for labels in (0.02, 0.1) for used in (0.25, 1.0)]
    plot_measure([*items, summary("vae", 0.1, 0.3)], "x.png", by=("demonstrations",))  # run with all of them only
    assert names(figures[0]) == ["koap, 2 %", "koap, 10 %"]
    few, many = figures[0].axes[0].lines
    assert points(few) == points(many) == [(0.25, 60), (1, 60)]
    assert few.get_color() == many.get_color() and few.get_marker() != many.get_marker()
    plot_measure(
        [summary("koap", 0.1, 0.6, demonstrations=0.25), summary("vae", 0.1, 0.3)], "x.png", by=("demonstrations",)
    )
    assert names(figures[1]) == ["koap", "vae"]  # points, where no method was run with several shares


def test_averages_over_tasks_are_in_percent_by_level(figures):
    plot_average({"koap": [(1, 0.8, 0.7, 0.9, 0.95), (2, 0.9, 0.8, 1.0, None)]}, 5, "x.png")
    (axes,) = figures[0].axes
    assert [points(line) for line in axes.lines] == [[(1, 80), (2, 90)], [(1, 95)]]
    heights = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == pytest.approx((70, 100)) and axes.get_xlim() == (0.75, 2.25)
    assert axes.get_title(loc="left").startswith("mean over 5 tasks, 95 % interval\nhollow")


def test_methods_differ_without_colour():
    styles = list(method_styles([f"method {number}" for number in range(27)]).values())
    assert len({str(style) for style in styles}) == 27 and len({style["marker"] for style in styles[:12]}) == 12
    assert len({(style["color"], str(style["linestyle"])) for style in styles[:12]}) == 12


def test_intervals_are_drawn_side_by_side_on_any_axis(figures):
    items = [
        summary(method, labels, 0.5, labelled_transitions=800 + 800 * labels)
        for method in "abcde"
        for labels in (0.01, 0.1)
    ]
    plot_measure(items, "x.png", by=("labels", "labelled_transitions"))
    figures[0].draw_without_rendering()
    for axes in figures[0].axes:
        left, right = (line.get_transform().transform(line.get_xydata()[0])[0] for line in axes.lines[::4])
        assert 0.05 < (right - left) / figures[0].dpi < 0.15  # inches


@pytest.mark.parametrize("errors", [(0.6, 0.7), (2.8, 3.1), (0.9, 5.0), (0.3, 30.0)])
def test_every_line_across_errors_has_its_number_and_there_are_two(errors, figures):
    items = [
        summary("koap", labels, 0.5, action_error=error) for labels, error in zip((0.01, 0.1), errors, strict=True)
    ]
    plot_measure(items, "x.png", "action_error")
    figures[0].draw_without_rendering()
    (axes,) = figures[0].axes
    low, high = axes.get_ylim()
    named = [tick for tick in axes.yaxis.get_major_ticks() if low <= tick.get_loc() <= high]
    assert len(named) >= 2 and all(tick.label1.get_text() for tick in named)
    assert not any(tick.gridline.get_visible() for tick in axes.yaxis.get_minor_ticks())
