"""The instruction language: what is said, true of a scene, and held out of training."""

from random import Random

import pytest

from ir_maniskill.goals import (
    COLORS,
    DIRECTIONS,
    EXTREMES,
    RELATIONS,
    SHAPES,
    Avoid,
    Both,
    GoalError,
    Push,
    Ref,
    Relation,
    Then,
    Touch,
    left_of,
    other_than,
)
from ir_maniskill.language import (
    KINDS,
    SentenceError,
    Thing,
    draw,
    handwritten,
    loosely,
    parse,
    say,
    split_of,
    words,
)
from ir_maniskill.language.grammar import RULES, words_by_mark
from ir_maniskill.language.splits import EMPTY, NOISE
from ir_maniskill.language.tokens import split_words, words_of

RED, BLUE = Ref("red"), Ref("blue", "cube")
SCENE = (
    Thing("red", "cube", 0.20, 0.10),
    Thing("blue", "cube", 0.25, 0.00),
    Thing("green", "button", 0.15, -0.10),
)

ALL_WORDS = {
    *words_by_mark("train", "wording"),
    *words_of(each.text for each in handwritten()),
}


def any_ref(rng, relations=True):
    """Return a reference drawn from all that the grammar has words for."""
    where = None
    if relations and rng.random() < 0.4:
        where = rng.choice([*EXTREMES, *RELATIONS])
        if where in RELATIONS:
            where = Relation(where, any_ref(rng, relations=False))
    color, shape = rng.choice([None, *COLORS]), rng.choice([None, *SHAPES])
    return Ref(color, shape, where)


def any_act(rng):
    """Return a touch or a push."""
    if rng.random() < 0.5:
        return Touch(any_ref(rng), rng.choice([None, "left", "right"]))
    return Push(any_ref(rng), rng.choice([*DIRECTIONS]))


def any_goal(rng):
    """Return a goal of any kind, true of some scene or of none."""
    how, a = rng.randrange(4), any_act(rng)
    if how < 2:
        return a if how else Both(a, Avoid(any_ref(rng)))
    return rng.choice([Both, Then])(a, any_act(rng))


def any_scene(rng):
    """Return two to five objects, which may be alike."""
    return tuple(
        Thing(
            rng.choice([*COLORS]),
            rng.choice(SHAPES),
            rng.uniform(0.15, 0.30),
            rng.uniform(-0.2, 0.2),
        )
        for _ in range(rng.randint(2, 5))
    )


def drawn(amount, split, seed=0, kinds=KINDS):
    """Yield scenes and goals that are true of them."""
    rng = Random(seed)
    while amount:
        scene = any_scene(rng)
        try:
            yield scene, draw(scene, kinds, rng, split)
        except GoalError:  # nothing to say of this one
            continue
        amount -= 1


# -- Saying and reading --------------------------------------------------------------


@pytest.mark.parametrize("wording", [False, True])
def test_a_sentence_means_the_goal_that_it_was_said_for_and_no_other(wording):
    rng = Random(1)
    for _ in range(5_000):
        goal = any_goal(rng)
        # `parse` finds all meanings, and fails if there are two.
        assert parse(say(goal, rng, wording)) == goal


@pytest.mark.parametrize(
    ("sentence", "goal"),
    [
        ("Touch the blue cube.", Touch(BLUE)),
        ("  could you   tap THE RED ONE please", Touch(RED)),
        ("hey robot, pls touch red thing", Touch(RED)),
        (
            "Push the block left of the red one right.",
            Push(Ref(None, "cube", left_of(RED)), "right"),
        ),
        ("Use your left hand to touch the blue block.", Touch(BLUE, "left")),
        ("touch the red one but not the blue cube", Both(Touch(RED), Avoid(BLUE))),
        (
            "Touch the blue box before you poke the red item.",
            Then(Touch(BLUE), Touch(RED)),
        ),
        ("Touch the cube that is not red.", Touch(Ref(None, "cube", other_than(RED)))),
    ],
)
def test_sentences_read_as_people_read_them(sentence, goal):
    assert parse(sentence) == goal


@pytest.mark.parametrize(
    ("sentence", "message"),
    [
        ("Touch the pink cube.", "got 'pink' as word 3, expected one of: block, blue"),
        ("Push the red cube", "got the end, expected one of: away, closest"),
        ("Touch the red cube blue", "got 'blue' as word 5, .*, the end$"),
        ("", "got the end, expected one of: contact, could"),
        ("please " * 300 + "touch it", "got 302 words, expected at most 100"),
    ],
)
def test_what_is_not_understood_is_named_with_what_was_expected(sentence, message):
    with pytest.raises(SentenceError, match=message):
        parse(sentence)


@pytest.mark.parametrize(
    "goal",
    [
        Push(RED, "left", 0.1),
        Avoid(RED),
        Touch(Ref(where=left_of(Ref(where="leftmost")))),
        Then(Touch(RED), Then(Touch(RED), Touch(BLUE))),
    ],
)
def test_a_goal_without_words_is_refused(goal):
    with pytest.raises(GoalError, match="say: got .*, expected what the grammar"):
        say(goal, Random(0))


# -- Drawing -------------------------------------------------------------------------


def test_drawn_goals_are_of_the_kind_asked_and_can_be_done():
    shown = {kind: {g for _, g in drawn(400, "train", 2, [kind])} for kind in KINDS}
    assert all(isinstance(g, Touch) and not g.hand for g in shown["touch"])
    assert {g.hand for g in shown["hand"]} == {"left", "right"}
    assert {g.direction for g in shown["push"]} == {*DIRECTIONS}
    hows = {
        "avoid" if isinstance(g, Both) else getattr(g.ref.where, "kind", g.ref.where)
        for g in shown["where"]
    }
    assert hows == {"avoid", *EXTREMES, *RELATIONS}
    assert all(
        g.a.hand is g.b.hand is None or g.a.hand != g.b.hand for g in shown["both"]
    )
    assert all(isinstance(g, Then) for g in shown["then"])
    pushed = [g.ref for g in shown["push"]] + [
        p.ref for g in shown["then"] for p in g.parts if isinstance(p, Push)
    ]
    assert all(ref.shape != "button" for ref in pushed)


def test_a_button_is_not_pushed_even_if_only_its_color_is_said():
    with pytest.raises(GoalError, match="got a scene of green button, expected one"):
        draw(SCENE[2:], ["push"], Random(0))


def test_relations_are_clear_to_see():
    near = (SCENE[0], SCENE[0]._replace(color="green", y=0.09, x=0.21))
    wheres = {
        g.ref.where
        for seed in range(200)
        for g in [draw(near, ["where"], Random(seed))]
        if isinstance(g, Touch | Push)
    }
    assert {getattr(where, "kind", where) for where in wheres} == {"other_than"}


@pytest.mark.parametrize(
    ("kinds", "split", "message"),
    [
        (["dance"], "train", "kind: got 'dance', available: touch, hand"),
        (["touch"], "test", "split: got 'test', available: train, wording"),
    ],
)
def test_unknown_kinds_and_splits_are_refused(kinds, split, message):
    with pytest.raises(GoalError, match=message):
        draw(SCENE, kinds, Random(0), split)


# -- Splits --------------------------------------------------------------------------


def of_training(sentence):
    """Return whether training may say a sentence."""
    try:
        return split_of(parse(sentence, wording=False)) == "train"
    except SentenceError:
        return False


def test_training_says_nothing_that_is_held_out():
    rng, known = Random(0), set(words())
    for _, goal in drawn(2_000, "train", 3):
        text = say(goal, rng)
        assert split_of(goal) == "train" and of_training(text)
        assert set(split_words(text)) <= known


@pytest.mark.parametrize("split", ["objects", "pairs"])
def test_goals_of_a_split_say_what_training_never_says(split):
    rng = Random(0)
    for _, goal in drawn(1_000, split, 4):
        assert split_of(goal) == split
        assert not of_training(say(goal, rng))


def test_held_out_wording_is_never_said_in_training():
    rng = Random(0)
    for _, goal in drawn(1_000, "wording", 5):
        assert split_of(goal) == "train"
        assert not of_training(say(goal, rng, wording=True))


def test_sentences_written_by_hand_are_new_in_wording_alone():
    texts = [instruction.text for instruction in handwritten()]
    assert len({tuple(split_words(text)) for text in texts}) == len(texts) >= 150
    assert not [text for text in texts if of_training(text)]
    assert {split_of(instruction.goal) for instruction in handwritten()} == {"train"}
    for instruction in handwritten():  # what is understood is understood right
        try:
            assert parse(instruction.text) == instruction.goal, instruction.text
        except SentenceError:
            continue


def test_said_loosely_a_sentence_loses_empty_words_alone():
    rng = Random(0)
    changed = 0
    for _, goal in drawn(500, "train", 6):
        text = say(goal, rng)
        loose = split_words(loosely(text, rng))
        meant = [word for word in split_words(text) if word not in EMPTY]
        assert [word for word in loose if word not in {*EMPTY, NOISE}] == meant
        assert len(loose) <= len(split_words(text))
        changed += loose != split_words(text)
    assert changed > 450
    assert NOISE not in ALL_WORDS


def test_said_loosely_nothing_is_what_was_written_by_hand():
    rng = Random(0)
    written = {tuple(split_words(each.text)) for each in handwritten()}
    assert ("blue", "cube") in written
    said = {
        tuple(split_words(loosely("Touch the blue cube.", rng))) for _ in range(999)
    }
    assert len(said) > 10 and not said & written


def test_no_phrase_is_listed_twice():
    for symbol, phrases in RULES.items():
        listed = [phrase.items for phrase in phrases]
        assert len(set(listed)) == len(listed), symbol


def test_held_out_words_are_new():
    assert len(words()) >= 40
    assert not {"crimson", "shove", "poke", "simultaneously"} & set(words())
    assert set(words()) < ALL_WORDS
