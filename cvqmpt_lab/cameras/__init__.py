"""Virtual depth cameras in numpy alone, so that training can see what evaluation sees."""
