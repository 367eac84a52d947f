"""Tasks: goal, observation, reward and success of each environment, and the clock that they share."""
