// include.cpp - a C++ program that includes the store's header and a generated one, and writes one value.
#include "fw_rtdb.h"
#include "roadtracker.h"

#include <cstring>

int main(int argc, char **argv) {
    fw_db *db = nullptr;
    if (argc < 2 || fw_attach(&db, argv[1]) < 0) return 1;
    fw_join_opts opts{};
    opts.version = "c++";
    int me = fw_join(db, "cpp", &opts);
    fw_spec spec{};
    std::strcpy(spec.name, "cpp/lane");
    spec.schema = static_cast<uint32_t>(fw_schema_add(db, FW_LANE_SCHEMA, sizeof FW_LANE_SCHEMA - 1));
    spec.size = sizeof(fw_Lane);
    spec.n_slots = 4;
    spec.every = 1;
    spec.component = static_cast<uint32_t>(me);
    fw_handle lane = fw_insert(db, &spec);
    fw_Lane value{1.5, -0.25};
    int64_t w = fw_write(db, lane, &value, sizeof value, fw_now_ns(db), nullptr, 0);
    fw_close(db);
    return me >= 0 && w == 1 ? 0 : 1;
}
