// Lesson 3, for rosserial: measurements says once a second what is in the air: dust, CO, LPG, methane, smoke, hydrogen,
// as the voltages of the sensors on A0 to A5 in volts.
#include <MiniRosserial.h>

const mini::Topic topics[] = {mini::says("measurements", mini::STRING)};
mini::Node node(Serial, topics);
unsigned long said;

void say() {
  char line[6 * 5 + 1], *at = line;
  for (uint8_t sensor = 0; sensor < 6; ++sensor) {
    if (sensor) *at++ = ' ';
    dtostrf(analogRead(sensor) * (5.0 / 1023), 4, 2, at);
    at += strlen(at);
  }
  node.publish(0, line);
}

void setup() { Serial.begin(57600); }

void loop() {
  node.spin();
  if (millis() - said < 1000) return;
  said = millis();
  say();
}
