"""Policy types this plugin registers, one folder per `--policy.type`."""
