"""The controller: model, estimation, tasks, QP, control law. Never imports hal, plant or MuJoCo."""
