// Lesson 1: /blink_led lets the lamp on pin 13 blink three times; /led says each time how it is now.
#include <AiraFrames.h>

void blink(aira::Call &call);

const aira::Firmware firmware PROGMEM = {"blink", "1.0"};
const aira::Topic topics[] PROGMEM = {
    {"/blink_led", "std_msgs/Empty", blink},
    {"/led", "std_msgs/String", nullptr},
};
aira::Link mesh(Serial, firmware, topics);

void lamp(uint8_t level) {
  digitalWrite(13, level);
  aira::Event led(mesh, 1);
  led.text(level ? F("on") : F("off"));
  led.send();
}

void blink(aira::Call &call) {
  for (uint8_t times = 3; times--;) {
    lamp(HIGH);
    mesh.wait(500);
    lamp(LOW);
    mesh.wait(500);
  }
}

void setup() {
  pinMode(13, OUTPUT);
  Serial.begin(57600);
  mesh.begin();
}

void loop() { mesh.poll(); }
