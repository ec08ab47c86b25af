// Lesson 2: /blink_led takes "red" (pin 13) or "blue" (pin 12) and lets that lamp blink three times.
#include <AiraFrames.h>

void blink(aira::Call &call);

const aira::Firmware firmware PROGMEM = {"colours", "1.0"};
const aira::Topic topics[] PROGMEM = {
    {"/blink_led", "std_msgs/String", blink},
    {"/led", "std_msgs/String", nullptr},
};
aira::Link mesh(Serial, firmware, topics);

void lamp(uint8_t pin, uint8_t level) {
  digitalWrite(pin, level);
  aira::Event led(mesh, 1);
  if (pin == 13) led.text(level ? F("red on") : F("red off"));
  else led.text(level ? F("blue on") : F("blue off"));
  led.send();
}

void blink(aira::Call &call) {
  const uint8_t pin = call.arguments.is(F("red")) ? 13 : call.arguments.is(F("blue")) ? 12 : 0;
  if (!pin) return call.fail(F("there is no such lamp"));
  for (uint8_t times = 3; times--;) {
    lamp(pin, HIGH);
    mesh.wait(500);
    lamp(pin, LOW);
    mesh.wait(500);
  }
}

void setup() {
  pinMode(13, OUTPUT);
  pinMode(12, OUTPUT);
  Serial.begin(57600);
  mesh.begin();
}

void loop() { mesh.poll(); }
