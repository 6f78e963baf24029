/* A Modbus server made of nothing but libmodbus: 1000 registers, each holding its own address, canaries in 0..3. */
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int main(int argc, char **argv) {
    int tcp = argc == 3 && strcmp(argv[1], "tcp") == 0, listener = -1, n, i;
    uint16_t canary[4] = {0x0102, 0x0304, 0x449A, 0x5000};
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 1000, 1000);
    modbus_t *bus = tcp ? modbus_new_tcp("127.0.0.1", atoi(argv[2])) : modbus_new_rtu(argv[2], 115200, 'N', 8, 1);

    if (map == NULL || bus == NULL || modbus_set_slave(bus, 1) == -1) return 1;
    for (i = 0; i < 1000; i++) map->tab_registers[i] = map->tab_input_registers[i] = i < 4 ? canary[i] : i;
    if (tcp ? (listener = modbus_tcp_listen(bus, 1)) == -1 : modbus_connect(bus) == -1) return 1;
    puts("ready");
    fflush(stdout);
    while (!tcp || modbus_tcp_accept(bus, &listener) != -1) {
        while ((n = modbus_receive(bus, query)) != -1) {
            if (n > 0) modbus_reply(bus, query, n, map);
            memcpy(map->tab_input_registers, map->tab_registers, 1000 * sizeof(uint16_t));
        }
        if (!tcp) return 0;
        modbus_close(bus);
    }
    return 0;
}
