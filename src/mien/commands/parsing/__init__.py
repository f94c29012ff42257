"""Between tyro and the commands: options of settings, help, messages, and files of settings."""
