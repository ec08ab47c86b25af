// Lesson 3: /measurements says once a second what is in the air: dust, CO, LPG, methane, smoke, hydrogen, as the
// voltages of the sensors on A0 to A5 in volts.
#include <AiraFrames.h>

const aira::Firmware firmware PROGMEM = {"air pollution", "1.0"};
const aira::Topic topics[] PROGMEM = {{"/measurements", "std_msgs/String", nullptr}};
aira::Link mesh(Serial, firmware, topics);
unsigned long said;

void say() {
  char line[6 * 5 + 1], *at = line;
  for (uint8_t sensor = 0; sensor < 6; ++sensor) {
    if (sensor) *at++ = ' ';
    dtostrf(analogRead(sensor) * (5.0 / 1023), 4, 2, at);
    at += strlen(at);
  }
  aira::Event measurements(mesh, 0);
  measurements.text(line);
  measurements.send();
}

void setup() {
  Serial.begin(57600);
  mesh.begin();
}

void loop() {
  mesh.poll();
  if (millis() - said < 1000) return;
  said = millis();
  say();
}
