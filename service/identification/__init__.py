"""From a campaign to error motions with uncertainty: solved, judged, stored, predicted from."""
