// An Arduino Uno without hardware: firmware in simavr, its serial line on a pseudo-terminal, controlled by lines of text.
//
//   board FIRMWARE.elf LINK [reset]
//
// LINK is made to point to the terminal; with `reset` each opening of the terminal resets the board, as a real one does.
// Lines on stdin: adc CHANNEL MILLIVOLTS | noise RATE SEED | unplug | plug | reset | quit
// Says on stdout: port PATH | pin NUMBER LEVEL MICROSECONDS | opened | closed | unplugged | crashed | unknown LINE
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <simavr/avr_adc.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

enum {
  HERTZ = 16000000,
  SLICE = 1000000,     // nanoseconds that are simulated at a time
  LATE = 100 * SLICE,  // behind by more than this, the board gives up to catch up
  BITS = 10,           // of a byte on the line
  UCSR0A = 0xC0, UBRR0L = 0xC4, UBRR0H = 0xC5, U2X = 1 << 1,
};

struct board {
  avr_t *avr;
  const char *link;
  bool resets;             // when the terminal is opened
  avr_uart_t *uart;
  int terminal;            // -1 while unplugged
  bool open;               // somebody has the terminal open
  uint8_t incoming[4096];  // on their way to the board
  size_t begin, end;
  bool sending;            // a byte to the board is on the line
  double noise;            // how many of the bytes are damaged, each way
  unsigned seed;
  int8_t levels[20];
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

static uint8_t over_the_line(struct board *board, uint8_t byte) {
  if (board->noise > 0 && rand_r(&board->seed) < board->noise * ((double)RAND_MAX + 1))
    byte ^= 1 + rand_r(&board->seed) % 255;
  return byte;
}

static avr_cycle_count_t byte_time(const struct board *board) {
  const uint8_t *data = board->avr->data;
  const unsigned divider = (data[UBRR0H] << 8 | data[UBRR0L]) + 1;
  return (avr_cycle_count_t)BITS * (data[UCSR0A] & U2X ? 8 : 16) * divider;
}

// simavr counts eleven bits a byte, and resets that whenever the firmware sets the baud rate.
static void keep_time(struct board *board) {
  board->uart->cycles_per_byte = byte_time(board);
}

// A byte has reached the board; the next one is on the line.
static avr_cycle_count_t arrive(avr_t *avr, avr_cycle_count_t when, void *context) {
  struct board *board = context;
  if (board->begin == board->end) {
    board->sending = false;
    return 0;
  }
  const uint8_t byte = over_the_line(board, board->incoming[board->begin]);
  board->begin = (board->begin + 1) % sizeof board->incoming;
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), byte);
  return when + byte_time(board);
}

static void say(struct avr_irq_t *irq, uint32_t value, void *context) {
  struct board *board = context;
  (void)irq;
  if (!board->open) return;
  const uint8_t byte = over_the_line(board, value);
  // What the terminal has no room for is lost, as it is where nobody reads a real port.
  if (write(board->terminal, &byte, 1) < 0 && errno != EAGAIN && errno != EIO) perror("write");
}

// The Arduino's number of the pin is in the order of PORTD, PORTB, PORTC.
static void change(struct board *board, int pin, uint32_t level) {
  if (pin >= 20 || board->levels[pin] == (int8_t)level) return;
  board->levels[pin] = level;
  printf("pin %d %u %llu\n", pin, level, (unsigned long long)(board->avr->cycle / (HERTZ / 1000000)));
}

#define PORT(name, first)                                                               \
  static void change_##name(struct avr_irq_t *irq, uint32_t value, void *context) {     \
    change(context, (first) + (int)irq->irq, value & 1);                                \
  }
PORT(d, 0)
PORT(b, 8)
PORT(c, 14)

static void watch(struct board *board, char port, int pins, avr_irq_notify_t notify) {
  for (int pin = 0; pin < pins; pin++)
    avr_irq_register_notify(avr_io_getirq(board->avr, AVR_IOCTL_IOPORT_GETIRQ(port), pin), notify, board);
}

static int plug(struct board *board) {
  int slave;
  char path[64];
  struct termios raw;
  if (board->terminal >= 0) return 0;
  if (openpty(&board->terminal, &slave, path, NULL, NULL)) return perror("openpty"), 1;
  tcgetattr(slave, &raw);
  cfmakeraw(&raw);
  tcsetattr(slave, TCSANOW, &raw);
  close(slave);
  fcntl(board->terminal, F_SETFL, O_NONBLOCK);
  unlink(board->link);
  if (symlink(path, board->link)) return perror(board->link), 1;
  printf("port %s\n", board->link);
  return 0;
}

static void unplug(struct board *board) {
  if (board->terminal < 0) return;
  unlink(board->link);
  close(board->terminal);
  board->terminal = -1;
  board->open = false;
  board->begin = board->end;
  puts("unplugged");
}

static void reset(struct board *board) {
  avr_reset(board->avr);
  avr_cycle_timer_cancel(board->avr, arrive, board);
  board->sending = false;
  board->begin = board->end;
}

// What the last one left unread is not for the next one to read.
static void flush_terminal(struct board *board) {
  const int slave = open(ptsname(board->terminal), O_RDWR | O_NOCTTY | O_NONBLOCK);
  if (slave < 0) return;
  tcflush(slave, TCIOFLUSH);
  close(slave);
}

static void look_at_terminal(struct board *board) {
  if (board->terminal < 0) return;
  struct pollfd terminal = {board->terminal, POLLIN, 0};
  poll(&terminal, 1, 0);
  const bool open = !(terminal.revents & POLLHUP);
  if (open != board->open) {
    board->open = open;
    puts(open ? "opened" : "closed");
    if (open && board->resets) reset(board);
    if (!open) flush_terminal(board);
  }
  if (!(terminal.revents & POLLIN)) return;
  uint8_t bytes[256];
  const size_t used = (board->end + sizeof board->incoming - board->begin) % sizeof board->incoming;
  if (used + sizeof bytes >= sizeof board->incoming) return;  // the host's writes wait, as for a real line
  const ssize_t count = read(board->terminal, bytes, sizeof bytes);
  for (ssize_t index = 0; index < count; index++) {
    board->incoming[board->end] = bytes[index];
    board->end = (board->end + 1) % sizeof board->incoming;
  }
  if (count > 0 && !board->sending) {
    board->sending = true;
    avr_cycle_timer_register(board->avr, byte_time(board), arrive, board);
  }
}

static void obey(struct board *board, char *line) {
  unsigned channel, millivolts;
  double noise;
  line[strcspn(line, "\n")] = 0;
  if (sscanf(line, "adc %u %u", &channel, &millivolts) == 2 && channel < 8 && millivolts <= 5000) {
    avr_raise_irq(avr_io_getirq(board->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + channel), millivolts);
  } else if (sscanf(line, "noise %lf %u", &noise, &board->seed) >= 1 && noise >= 0 && noise <= 1) {
    board->noise = noise;
  } else if (!strcmp(line, "unplug")) {
    unplug(board);
  } else if (!strcmp(line, "plug")) {
    plug(board);
  } else if (!strcmp(line, "reset")) {
    reset(board);
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
    look_at_terminal(board);
    keep_time(board);
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
  if (count < 3) return fprintf(stderr, "usage: %s FIRMWARE.elf LINK [reset]\n", words[0]), 2;
  prctl(PR_SET_PDEATHSIG, SIGTERM);
  signal(SIGTERM, stop);
  signal(SIGINT, stop);
  signal(SIGPIPE, SIG_IGN);
  if (getppid() != parent) return 1;  // it ended before it could be watched
  setvbuf(stdout, NULL, _IOLBF, 0);
  if (elf_read_firmware(words[1], &firmware)) return fprintf(stderr, "board: can't read %s\n", words[1]), 2;
  board.link = words[2];
  board.resets = count > 3 && !strcmp(words[3], "reset");
  board.avr = avr_make_mcu_by_name("atmega328p");
  avr_init(board.avr);
  board.avr->frequency = HERTZ;
  board.avr->log = LOG_ERROR;
  board.avr->sleep = dont_sleep;
  avr_load_firmware(board.avr, &firmware);
  board.avr->vcc = board.avr->avcc = board.avr->aref = 5000;
  uint32_t flags = 0;
  avr_ioctl(board.avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  avr_irq_register_notify(avr_io_getirq(board.avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), say, &board);
  for (avr_io_t *io = board.avr->io_port; io; io = io->next)
    if (!strcmp(io->kind, "uart")) board.uart = (avr_uart_t *)io;  // an Uno has one
  watch(&board, 'D', 8, change_d);
  watch(&board, 'B', 6, change_b);
  watch(&board, 'C', 6, change_c);
  if (plug(&board)) return 1;
  run(&board);
  unplug(&board);
  return 0;
}
