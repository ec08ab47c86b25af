// An Arduino Uno without hardware: firmware in simavr, its serial line on a pseudo-terminal, controlled by lines of text.
//
//   board FIRMWARE.elf LINK [reset] [monitor]
//
// LINK is made to point to the terminal; with `reset` each opening of the terminal resets the board, as a real one does,
// and with `monitor` what the board sends is shown from the start.
// Lines on stdin: pin NUMBER high|low|free | adc CHANNEL MILLIVOLTS | send TEXT | monitor on|off | noise RATE SEED |
//   unplug | plug | reset | quit
// Says on stdout: port PATH | pin NUMBER LEVEL MICROSECONDS | pwm NUMBER VALUE TOP MICROSECONDS | serial TEXT | opened |
//   closed | unplugged | crashed | unknown LINE
#define _GNU_SOURCE
#include "board.h"

#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_adc.h>
#include <simavr/sim_elf.h>

enum {
  SLICE = 1000000,     // nanoseconds that are simulated at a time
  LATE = 100 * SLICE,  // behind by more than this, the board gives up to catch up
};

static volatile sig_atomic_t stopped;

static void stop(int number) {
  (void)number;
  stopped = 1;
}

static int64_t now(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (int64_t)time.tv_sec * 1000000000 + time.tv_nsec;
}

static void obey(struct board *board, char *line) {
  unsigned channel, millivolts, pin;
  double noise;
  char level[8];
  line[strcspn(line, "\n")] = 0;
  if (sscanf(line, "adc %u %u", &channel, &millivolts) == 2 && channel < 8 && millivolts <= 5000) {
    avr_raise_irq(avr_io_getirq(board->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + channel), millivolts);
  } else if (sscanf(line, "noise %lf %u", &noise, &board->seed) >= 1 && noise >= 0 && noise <= 1) {
    board->noise = noise;
  } else if (sscanf(line, "pin %u %7s", &pin, level) == 2 && hold_pin(board, pin, level)) {
  } else if (!strncmp(line, "send ", 5)) {
    send_text(board, line + 5);
  } else if (!strcmp(line, "monitor on") || !strcmp(line, "monitor off")) {
    monitor(board, !strcmp(line, "monitor on"));
  } else if (!strcmp(line, "unplug")) {
    unplug(board);
  } else if (!strcmp(line, "plug")) {
    plug(board);
  } else if (!strcmp(line, "reset")) {
    restart(board);
  } else if (!strcmp(line, "quit")) {
    stopped = 1;
  } else if (*line) {
    printf("unknown %s\n", line);
  }
}

// Lines from stdin; its end means nothing, as the board may run without.
static void look_at_stdin(struct board *board) {
  static char text[4096];
  static size_t length;
  static bool ended;
  struct pollfd input = {STDIN_FILENO, POLLIN, 0};
  if (ended || poll(&input, 1, 0) < 1) return;
  const ssize_t count = read(STDIN_FILENO, text + length, sizeof text - 1 - length);
  if (count <= 0) {
    ended = true;
    return;
  }
  length += count;
  text[length] = 0;
  char *line = text;
  for (char *end; (end = strchr(line, '\n')); line = end + 1) {
    *end = 0;
    obey(board, line);
  }
  length = strlen(line);
  memmove(text, line, length + 1);
  if (length == sizeof text - 1) length = 0;
}

static void dont_sleep(avr_t *avr, avr_cycle_count_t cycles) {
  (void)avr;
  (void)cycles;
}

static void run(struct board *board) {
  avr_t *avr = board->avr;
  int64_t begun = now(), next = begun;
  avr_cycle_count_t cycles = avr->cycle;
  while (!stopped) {
    look_at_stdin(board);
    look_at_line(board);
    look_at_pins(board);
    next += SLICE;
    const avr_cycle_count_t until = cycles + (next - begun) / 1000 * (HERTZ / 1000000);
    while (avr->cycle < until) {
      const int state = avr_run(avr);
      if (state == cpu_Crashed || state == cpu_Done) {
        puts("crashed");
        return;
      }
    }
    const int64_t time = now();
    if (time < next) {
      const struct timespec pause = {0, next - time};
      nanosleep(&pause, NULL);
    } else if (time - next > LATE) {
      begun = next = time;
      cycles = avr->cycle;
    }
  }
}

int main(int count, char **words) {
  static struct board board = {.terminal = -1};
  static elf_firmware_t firmware;
  const int parent = getppid();
  if (count < 3) return fprintf(stderr, "usage: %s FIRMWARE.elf LINK [reset] [monitor]\n", words[0]), 2;
  prctl(PR_SET_PDEATHSIG, SIGTERM);
  signal(SIGTERM, stop);
  signal(SIGINT, stop);
  signal(SIGPIPE, SIG_IGN);
  if (getppid() != parent) return 1;  // it ended before it could be watched
  setvbuf(stdout, NULL, _IOLBF, 0);
  if (elf_read_firmware(words[1], &firmware)) return fprintf(stderr, "board: can't read %s\n", words[1]), 2;
  board.link = words[2];
  for (int each = 3; each < count; ++each) {
    board.resets |= !strcmp(words[each], "reset");
    board.monitored |= !strcmp(words[each], "monitor");
  }
  board.avr = avr_make_mcu_by_name("atmega328p");
  avr_init(board.avr);
  board.avr->frequency = HERTZ;
  board.avr->log = LOG_ERROR;
  board.avr->sleep = dont_sleep;
  avr_load_firmware(board.avr, &firmware);
  board.avr->vcc = board.avr->avcc = board.avr->aref = 5000;
  watch_line(&board);
  watch_pins(&board);
  if (plug(&board)) return 1;
  run(&board);
  unplug(&board);
  return 0;
}
