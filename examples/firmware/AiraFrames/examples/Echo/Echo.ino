// Answers each call with what it was given.
#include <AiraFrames.h>

#ifndef BAUD
#define BAUD 57600
#endif

void echo(aira::Call &call) { call.answer.raw(call.arguments.data(), call.arguments.size()); }

const aira::Firmware firmware PROGMEM = {"echo", "1.0"};
const aira::Topic topics[] PROGMEM = {{"/echo", "json", echo}};
aira::Link mesh(Serial, firmware, topics);

void setup() {
  Serial.begin(BAUD);
  mesh.begin();
}

void loop() { mesh.poll(); }
