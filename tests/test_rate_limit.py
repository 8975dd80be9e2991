from viewer.page.page import MIN_INTERVAL_S, RateLimit


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
