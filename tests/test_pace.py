from viewer.display.pace import LEAST_S, REST, Pace


class Hands:
    """A clock and an account of CPU seconds that are set by hand."""

    def __init__(self):
        self.clock, self.spent = 100.0, 7.0
        self.pace = Pace(lambda: self.clock, lambda: self.spent)


def test_the_first_sending_is_due_at_once_and_a_cheap_one_every_two_seconds():
    hands = Hands()
    assert hands.pace.is_due()
    hands.pace.begin()
    hands.spent += 0.01
    assert not hands.pace.is_due()
    hands.clock += LEAST_S - 0.1
    assert not hands.pace.is_due()
    hands.clock += 0.1
    assert hands.pace.is_due()


def test_a_dear_sending_is_followed_by_a_rest_of_so_many_times_its_cost():
    hands = Hands()
    hands.pace.begin()
    hands.spent += 1.0  # also what other threads spend on it, until somebody asks
    assert not hands.pace.is_due()
    hands.spent += 5.0  # other work, later
    hands.clock += REST - 0.1
    assert not hands.pace.is_due()
    hands.clock += 0.2
    assert hands.pace.is_due()
