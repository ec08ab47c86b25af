// Moves (the lamp is on) from /move until it hears /stop.
#include <AiraFrames.h>

#ifndef BAUD
#define BAUD 57600
#endif

void move(aira::Call &call) { digitalWrite(LED_BUILTIN, HIGH); }

void stop(aira::Call &call) { digitalWrite(LED_BUILTIN, LOW); }

const aira::Firmware firmware PROGMEM = {"stop", "1.0"};
const aira::Topic topics[] PROGMEM = {
    {"/move", "json", move},
    {"/stop", "std_msgs/String", stop},  // with the reason
};
aira::Link mesh(Serial, firmware, topics);

void setup() {
  pinMode(LED_BUILTIN, OUTPUT);
  Serial.begin(BAUD);
  mesh.begin();
}

void loop() { mesh.poll(); }
