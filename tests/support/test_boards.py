from __future__ import annotations

import subprocess
from typing import TYPE_CHECKING

from tests.support.peers import require

if TYPE_CHECKING:
    from pathlib import Path

FIRMWARE = """
#include <avr/io.h>
int main(void) { DDRB |= 1 << 5; PORTB |= 1 << 5; for (;;) {} }
"""
# Runs the firmware for a moment and exits with 0 once Arduino pin 13 is high.
HOST = """
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/avr_ioport.h>
static void see(struct avr_irq_t *irq, uint32_t value, void *seen) { *(int *)seen |= value; }
int main(int count, char **words) {
    elf_firmware_t firmware = {0};
    int high = 0;
    if (elf_read_firmware(words[1], &firmware)) return 2;
    avr_t *board = avr_make_mcu_by_name("atmega328p");
    avr_init(board);
    board->frequency = 16000000;
    avr_load_firmware(board, &firmware);
    avr_irq_register_notify(avr_io_getirq(board, AVR_IOCTL_IOPORT_GETIRQ('B'), 5), see, &high);
    for (int step = 0; step < 1000 && !high; step++) avr_run(board);
    return high ? 0 : 1;
}
"""


def test_avr_gcc_compiles_what_libsimavr_runs(tmp_path: Path) -> None:
    compiler, _ = require("avr-gcc"), require("libsimavr")
    (tmp_path / "firmware.c").write_text(FIRMWARE)
    (tmp_path / "host.c").write_text(HOST)
    firmware, host = tmp_path / "firmware.elf", tmp_path / "host"
    build(compiler, "-mmcu=atmega328p", "-Os", tmp_path / "firmware.c", "-o", firmware)
    build("gcc", tmp_path / "host.c", "-o", host, "-lsimavr")
    assert subprocess.run([host, firmware], timeout=60, check=False).returncode == 0


def test_the_arduino_core_has_its_sources() -> None:
    assert (require("arduino-core") / "cores" / "arduino" / "Arduino.h").is_file()


def build(*command: str | Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
