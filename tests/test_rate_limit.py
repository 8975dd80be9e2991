from viewer.display.rate_limit import COST_FACTOR, MIN_INTERVAL_S, RateLimit


class Hands:
    """A clock and an account of CPU seconds that are set by hand."""

    def __init__(self):
        self.clock, self.spent = 100.0, 7.0
        self.limit = RateLimit(lambda: self.clock, lambda: self.spent)


def test_the_first_sending_is_due_at_once_and_a_cheap_one_every_two_seconds():
    hands = Hands()
    assert hands.limit.is_due()
    hands.limit.begin()
    hands.spent += 0.01
    assert not hands.limit.is_due()
    hands.clock += MIN_INTERVAL_S - 0.1
    assert not hands.limit.is_due()
    hands.clock += 0.1
    assert hands.limit.is_due()


def test_a_dear_sending_is_followed_by_a_rest_of_so_many_times_its_cost():
    hands = Hands()
    hands.limit.begin()
    hands.spent += 1.0  # also what other threads spend on it, until somebody asks
    assert not hands.limit.is_due()
    hands.spent += 5.0  # other work, later
    hands.clock += COST_FACTOR - 0.1
    assert not hands.limit.is_due()
    hands.clock += 0.2
    assert hands.limit.is_due()
