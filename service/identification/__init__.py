"""From a campaign to error motions with uncertainty: solve, judge, store and predict."""
