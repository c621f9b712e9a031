"""Where frames come from: files now, devices later."""
