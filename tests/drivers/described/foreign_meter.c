/* A displacement meter of nobody here: a Modbus server made of libmodbus, with a register map and a word order of its own.
 *
 * Low register first (CDAB). Input registers: 100 u32 0x12345678, 102 u32 serial number, 104 u16 start number, 110 i32 pulses of 10 nm,
 * 112 u32 milliseconds, 114 u16 readings so far, 115 u16 state (bit 2: count lost, bit 3: weak), 116 f32 air in degrees Fahrenheit.
 * Holding register 50: 7 sets the pulses to zero and is acknowledged by 107 in register 51.
 * A file shared with the test says where the target is: int32 pulses, uint32 ms (0: its own clock), uint32 stuck (2: once back), uint32 state, uint32 ABCD.
 * With a track (its length n, then n times uint32 ms and int32 pulses) every reading is 40 ms later than the one before, and on the track, with
 * a noise of +-300 nm.
 */
#include <errno.h>
#include <fcntl.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>

struct world { int32_t pulses; uint32_t ms, stuck, state, high_first, n; struct { uint32_t ms; int32_t pulses; } track[4000]; };

static void follow(volatile struct world *w) {
    uint32_t i = 0;
    if (w->n == 0) return;
    w->ms += 40;
    while (i + 1 < w->n && w->track[i + 1].ms <= w->ms) i++;
    w->pulses = w->track[i].pulses;
    if (i + 1 < w->n && w->track[i].ms <= w->ms)
        w->pulses += (int32_t)((double)(w->track[i + 1].pulses - w->track[i].pulses) * (w->ms - w->track[i].ms) / (w->track[i + 1].ms - w->track[i].ms));
    w->pulses += rand() % 61 - 30;
}

static void put32(uint16_t *at, uint32_t value, int high_first) {
    at[0] = high_first ? value >> 16 : value & 0xFFFF;
    at[1] = high_first ? value & 0xFFFF : value >> 16;
}

static void show(modbus_mapping_t *map, volatile struct world *w, int32_t zero, uint16_t start) {
    static uint16_t readings;
    static uint32_t ms;
    uint16_t *in = map->tab_input_registers;
    float air = 68.9f;
    uint32_t bits;
    memcpy(&bits, &air, 4);
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    follow(w);
    if (w->stuck == 2) { readings -= 9; w->stuck = 0; }
    if (w->stuck != 1) { readings++; ms = w->ms ? w->ms : (uint32_t)(now.tv_sec * 1000 + now.tv_nsec / 1000000); put32(in + 110, (uint32_t)(w->pulses - zero), w->high_first); }
    put32(in + 100, 0x12345678, w->high_first);
    put32(in + 102, 40175, w->high_first);
    in[104] = start;
    put32(in + 112, ms, w->high_first);
    in[114] = readings;
    in[115] = w->state;
    put32(in + 116, bits, w->high_first);
}

int main(int argc, char **argv) {
    int tcp = strcmp(argv[1], "tcp") == 0, listener = -1, n, handle = open(argv[3], O_RDWR);
    volatile struct world *w = mmap(NULL, sizeof(struct world), PROT_READ | PROT_WRITE, MAP_SHARED, handle, 0);
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 200, 200);
    modbus_t *bus = tcp ? modbus_new_tcp("127.0.0.1", atoi(argv[2])) : modbus_new_rtu(argv[2], 19200, 'N', 8, 1);
    int32_t zero = 0;

    if (argc != 4 || w == MAP_FAILED || map == NULL || bus == NULL || modbus_set_slave(bus, 1) == -1) return 1;
    if (tcp ? (listener = modbus_tcp_listen(bus, 1)) == -1 : modbus_connect(bus) == -1) return 1;
    puts("ready");
    fflush(stdout);
    while (!tcp || modbus_tcp_accept(bus, &listener) != -1) {
        while ((n = modbus_receive(bus, query)) != -1 || (!tcp && errno != EIO && errno != EBADF)) {
            if (n <= 0) continue;
            show(map, w, zero, 77);
            modbus_reply(bus, query, n, map);
            if (map->tab_registers[50] == 7) { zero = w->pulses; map->tab_registers[50] = 0; map->tab_registers[51] = 107; }
        }
        if (!tcp) return 0;
        modbus_close(bus);
    }
    return 0;
}
