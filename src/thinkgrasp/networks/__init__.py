"""Networks in plain torch, without compiled extensions; each module says what it was checked against."""
