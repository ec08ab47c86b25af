// Speaks plain text, as most sketches do: greets, then repeats each line.
void setup() {
  Serial.begin(9600);
  Serial.println("hello\t\x01");
}

void loop() {
  if (Serial.available()) {
    const String line = Serial.readStringUntil('\n');
    Serial.println("heard " + line);
  }
}
