"""The pages that people see: rendered on the server, complete without JavaScript, better with a little."""
