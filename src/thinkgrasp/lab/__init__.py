"""What a real cell needs beside a driver: its layout as a file, rules of safety, the person beside it, a log."""
