// A lamp with a dimmer on pin 9 and a button between pin 2 and ground: /dim takes 0 to 255, /button says how it is.
// With CHATTY it prints text all the time, as somebody who looks for a mistake may do.
#include <AiraFrames.h>

const uint8_t LAMP = 9, BUTTON = 2;

void dim(aira::Call &call);

const aira::Firmware firmware PROGMEM = {"dimmer", "1.0"};
const aira::Topic topics[] PROGMEM = {{"/dim", "json", dim}, {"/button", "json", nullptr}};
aira::Link mesh(Serial, firmware, topics);
bool pressed;

void dim(aira::Call &call) {
  const long level = call.arguments.integer();
  if (!call.arguments.good() || level < 0 || level > 255) return call.fail(F("0 to 255 is wanted"));
  analogWrite(LAMP, level);
  call.answer.integer(level);
}

void setup() {
  pinMode(BUTTON, INPUT_PULLUP);
  pinMode(LAMP, OUTPUT);
  Serial.begin(57600);
  mesh.begin();
}

void loop() {
#ifdef CHATTY
  Serial.print(F("here "));
#endif
  mesh.poll();
  const bool now = digitalRead(BUTTON) == LOW;
  if (now == pressed) return;
  pressed = now;
  aira::Event event(mesh, 1);
  event.boolean(pressed);
  event.send();
}
