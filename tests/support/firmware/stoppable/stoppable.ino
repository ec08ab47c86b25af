// Moves (pin 13 high) from /move until /stop, which keeps the reason; /reason answers it. /home moves for a moment (pin 12),
// /slow does nothing else for its milliseconds, with pin 11 high.
#include <AiraFrames.h>

#ifndef BAUD
#define BAUD 57600
#endif

void move(aira::Call &call);
void stop(aira::Call &call);
void home(aira::Call &call);
void slow(aira::Call &call);
void reason(aira::Call &call);

const aira::Firmware firmware PROGMEM = {"stoppable", "1.0"};
const aira::Topic topics[] PROGMEM = {
    {"/move", "json", move},
    {"/stop", "std_msgs/String", stop},
    {"/home", "json", home},
    {"/slow", "json", slow},
    {"/reason", "json", reason},
};
aira::Link mesh(Serial, firmware, topics);
char why[64];

void move(aira::Call &call) { digitalWrite(13, HIGH); }

void stop(aira::Call &call) {
  digitalWrite(13, LOW);
  call.arguments.text(why, sizeof why);
}

void home(aira::Call &call) {
  digitalWrite(12, HIGH);
  digitalWrite(12, LOW);
}

void slow(aira::Call &call) {
  digitalWrite(11, HIGH);
  mesh.wait(call.arguments.integer());
  digitalWrite(11, LOW);
}

void reason(aira::Call &call) { call.answer.text(why); }

void setup() {
  pinMode(11, OUTPUT);
  pinMode(12, OUTPUT);
  pinMode(13, OUTPUT);
  Serial.begin(BAUD);
  mesh.begin();
}

void loop() { mesh.poll(); }
