"""The page of an episode: it shows the recording's values, a section a step, and is whole, safe and sound HTML."""

import base64
import dataclasses
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from recordings import (
    EPISODE,
    LOST,
    POSES,
    PUSH,
    RECORDING,
    STEPS,
    evidence,
    record,
)

from mechsearch_jax.commands import main as cli
from mechsearch_jax.envs.page.page import page, stamp
from mechsearch_jax.envs.recording.recording import NAME, save_recording
from mechsearch_jax.envs.recording.step_values import ending, step_values
from mechsearch_jax.runtime.errors import InputError

VOID = {"img", "meta", "link", "br"}


class Parsed(HTMLParser):
    """A page as its elements: each tag is closed in its order, each image has words."""

    def __init__(self, text):
        super().__init__()
        self.open, self.texts, self.images, self.ids, self.links = [], [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "img":
            assert given["alt"].strip()
            self.images.append(given["src"])
        if "id" in given:
            self.ids.append(given["id"])
        if tag == "a":
            self.links.append(given["href"])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.texts.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.texts).split())


@pytest.fixture(scope="module")
def text():
    return page(LOST)


def test_a_page_is_sound_html_with_a_section_a_step_and_its_pictures(text):
    parsed = Parsed(text)
    assert parsed.ids == [f"step-{i + 1}" for i in range(len(STEPS))]
    assert parsed.links == [f"#{name}" for name in parsed.ids]
    # One of the end, and of each step what was seen, believed and recognised.
    assert len(parsed.images) == 1 + 3 * len(STEPS)
    for source in parsed.images:
        head, _, data = source.partition(",")
        assert head == "data:image/webp;base64"
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))
        assert picture.shape[1] > 400
        assert picture.std() > 5
    rest = re.sub(r"base64,[^\"]*", "", text)
    assert not re.search(r"https?:|<link|<script|@import|url\(", rest)
    assert f'content="mechsearch view --save {stamp()}"' in rest
    assert '<html lang="en">' in rest


def test_a_page_shows_the_values_of_the_recording(text):
    words = Parsed(text).words
    first, last = (step_values(LOST, i) for i in range(2))
    assert (first.poses, first.every) == (int(STEPS[0].existence.sum()), POSES)
    assert first.graspable == int((STEPS[0].existence & (STEPS[0].graspability == 1)).sum())
    assert f"f: {first.poses} of {first.every} poses; g: graspable at {first.graspable} of these" in words
    assert (first.cost, first.predicted, first.measured) == (100.0, 60.0, 95.0)
    assert "J: 100.0 before, 60.0 predicted, 95.0 measured" in words
    assert "Outcome: carried out, and the target came into view" in words
    assert first.moved == ()
    assert [(c.role, c.value, c.cost, c.poses) for c in first.candidates] == [
        ("chosen", -30.0, 90.0, POSES),
        ("next best", -10.0, 95.0, POSES),
    ]
    assert f"chosen push object 0 by 10 cm to the left -30.0 90.0 {POSES} {POSES}" in words
    harmful, good = first.trials
    assert (harmful.words, harmful.colour, harmful.chosen) == ("push object 0 by 20 cm to the left", "bad", False)
    assert (good.words, good.colour, good.chosen) == ("push object 0 by 10 cm to the left", "good", True)
    assert "push object 0 by 20 cm to the left did harm: something fell" in words
    assert (last.found, last.poses, last.grasps, last.free) == (True, 1, 2, 0)
    # The second grasp hits more than the first.
    assert (last.hits, last.blocked) == (("object 0",), (0,))
    assert "0 of 2 grasps within the arm’s reach meet nothing; all hit object 0" in words
    assert (last.candidates, last.cost, last.outcome) == ((), None, "")
    assert "the target was found, but is not out after 1 action: no grasp of it is free" in words
    assert "actions 1 of at most 1" in words


def test_what_the_belief_and_the_action_are_wrong_about_is_a_warning():
    def of(**changes):
        steps = (dataclasses.replace(EPISODE.steps[0], **changes), EPISODE.steps[1])
        return step_values(dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, steps=steps)), 0)

    assert of().warnings == ()
    assert of(truth_possible=False).warnings == ("the true pose is not in f",)
    assert of(restarts=1).warnings == ("f had become empty, and was started anew",)
    assert of(blind=True).warnings == ("the action sweeps space of which nothing was measured",)
    assert of(held_up=True, fallen=(2,)).warnings[0] == "the arm was held up"
    assert of(held_up=True, fallen=(2,)).warnings[1].startswith("object 2 fell off the board")
    assert of(failure="unreachable").outcome == "the arm cannot follow the motion"
    doubtful = dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, steps=(record(PUSH, blind=True),) * 2))
    assert "Warning: the action sweeps space" in Parsed(page(doubtful)).words
    mistaken = dataclasses.replace(STEPS[0], evidence=evidence(found=True))
    values = step_values(dataclasses.replace(LOST, steps=(mistaken, STEPS[1])), 0)
    assert (values.poses, values.warnings) == (1, ("something else is taken for the target",))


def test_endings_are_those_of_the_record():
    def of(**changes):
        return ending(dataclasses.replace(LOST, episode=dataclasses.replace(EPISODE, **changes)))

    leans = record(PUSH, at_rest=False, restless=("object 0 leans on the back wall",))
    lost = "the target was found, but is not out after 1 action"
    assert of()[:2] == (False, f"{lost}: no grasp of it is free")
    assert of(failure="retrieval: missed").title == f"{lost}: the hand missed the target"
    assert of(found_step=None, failure="not found").title == "the target was not found after 1 action"
    out = of(retrieved=True, failure=None, steps=(record(PUSH, at_rest=False), leans))
    assert out[:2] == (True, "the target is out after 2 actions; object 0 leans on the back wall")
    assert ending(RECORDING)[:2] == (None, "retrieved")


def test_what_an_earlier_recording_lacks_is_left_out_with_a_sentence():
    parsed = Parsed(page(RECORDING))
    assert "The recording is of an earlier version and lacks the episode’s record" in parsed.words
    assert "chosen push object 0 by 10 cm" in parsed.words
    assert len(parsed.ids) == 3
    for absent in ("Trials:", "recognised", "Outcome:", "Warning:"):
        assert absent not in parsed.words


def test_what_is_shown_is_escaped():
    evil = "<script>alert(1)</script>"
    steps = (dataclasses.replace(EPISODE.steps[0], failure=evil), EPISODE.steps[1])
    episode = dataclasses.replace(EPISODE, failure=evil, config={"policy": evil, "max_steps": 1}, steps=steps)
    text = page(dataclasses.replace(LOST, heading=f"{evil}: {evil}", episode=episode))
    assert text.count("alert(1)") >= 5
    assert "<script" not in text
    Parsed(text)


def test_bad_input_is_refused_in_one_line(tmp_path):
    for arguments, message in (
        (["--save", str(tmp_path / "page.html")], "recording.npz: there is none; search once more with --record"),
        (["--save", str(tmp_path / "page.pdf")], "page.pdf: ends in neither .html nor .htm"),
    ):
        with pytest.raises(InputError, match=re.escape(message)) as refused:
            cli.parse(["view", str(tmp_path), *arguments])()
        assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match=r"page.pdf: ends in neither"):
        cli.parse(["search", "first-light", "--out", str(tmp_path), "--page", str(tmp_path / "page.pdf")])()
    save_recording(LOST, tmp_path / NAME)
    with pytest.raises(InputError, match="view: --fps 0 is not between"):
        cli.parse(["view", str(tmp_path), "--save", str(tmp_path / "page.html"), "--fps", "0"])()
    for arguments, message in (
        (["--film", str(tmp_path / "film.mp4")], "view: --film is shown in a page; give --save, too"),
        (["--save", str(tmp_path / "page.html"), "--film", str(tmp_path / "film.avi")], "film.avi: ends in none of"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            cli.parse(["view", str(tmp_path), *arguments])()
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError, match="cannot be written"):
        cli.parse(["view", str(tmp_path), "--save", str(tmp_path / "taken" / "page.html")])()
