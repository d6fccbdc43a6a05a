/* A vehicle in C: it publishes an observation, waits for its acknowledgement, subscribes to alerts and queries a tile.
 *
 * It uses only the definitions in schemas/README.md and schemas/proto/gripmap.proto. It needs zenoh-pico or zenoh-c, version 1:
 *
 *   cc -std=c11 -DZENOH_LINUX -o client client.c $(pkg-config --cflags --libs zenohpico) -lm -lpthread
 *   cc -std=c11 -DUSE_ZENOH_C -o client client.c $(pkg-config --cflags --libs zenohc) -lm -lpthread
 *   ./client tcp/127.0.0.1:7447 anna 57.7 11.97 60
 *
 * Arguments: endpoint, enrolled name of the vehicle, latitude and longitude of the ice, seconds to wait. It prints one
 * line of JSON and returns 0 if the observation was acknowledged, an alert in its tile arrived and the tile arrived.
 */
#define _POSIX_C_SOURCE 200809L
#include <inttypes.h>
#include <math.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#ifdef USE_ZENOH_C
#include <zenoh.h>
#else
#include <zenoh-pico.h>
#endif

enum { VISITS = 6, ZOOM = 14, KEY_SIZE = 128, BATCH_SIZE = 4096, FIRST_RETRY_S = 2, LAST_RETRY_S = 6 };

static const double PI = 3.14159265358979323846;

/* ---- data that Zenoh's callbacks, which run on its threads, pass to the main thread ---- */

typedef struct {
    pthread_mutex_t lock;
    pthread_cond_t changed;
    uint64_t boot;
    bool is_durable;
    char rejection[200];
    bool is_alerted;
    float alert_mu;
    bool is_answered;
    int tiles;
    size_t tile_bytes;
    int cells;
} Heard;

/* ---- protobuf: read one field after the other ---- */

typedef struct {
    const uint8_t *at;
    const uint8_t *end;
} Reader;

typedef struct {
    uint32_t number;
    uint64_t value;  /* value of a varint, or the bits of a fixed-width number */
    Reader content;  /* content of a message, a string or bytes */
} Field;

static bool read_varint(Reader *reader, uint64_t *value) {
    *value = 0;
    for (int shift = 0; shift < 64 && reader->at < reader->end; shift += 7) {
        uint8_t byte = *reader->at++;
        *value |= (uint64_t)(byte & 127) << shift;
        if (byte < 128) return true;
    }
    return false;
}

static bool read_field(Reader *reader, Field *field) {
    uint64_t tag, size;
    if (!read_varint(reader, &tag)) return false;
    field->number = (uint32_t)(tag >> 3);
    switch (tag & 7) {
        case 0:
            return read_varint(reader, &field->value);
        case 1:
            size = 8;
            break;
        case 5:
            size = 4;
            break;
        case 2:
            if (!read_varint(reader, &size)) return false;
            break;
        default:
            return false;
    }
    if (size > (uint64_t)(reader->end - reader->at)) return false;
    field->content = (Reader){reader->at, reader->at + size};
    field->value = 0;
    for (uint64_t k = 0; (tag & 7) != 2 && k < size; k++) field->value |= (uint64_t)reader->at[k] << (8 * k);
    reader->at += size;
    return true;
}

static bool has_first_seq(Reader range) {
    Field field;
    int64_t first = 0, last = 0;
    while (read_field(&range, &field)) {
        if (field.number == 1) first = (int64_t)field.value;
        if (field.number == 2) last = (int64_t)field.value;
    }
    return first <= 1 && 1 <= last;
}

/* Record whether a StreamAck of this boot settles batch 1 of the observations: in `durable`, or in `rejected`. */
static void read_stream_ack(Reader stream, Heard *heard) {
    Field field;
    uint64_t boot = 0, kind = 0;
    bool is_durable = false;
    char reason[sizeof heard->rejection] = "";
    while (read_field(&stream, &field)) {
        if (field.number == 1) boot = field.value;
        if (field.number == 2) kind = field.value;
        if (field.number == 4) is_durable |= has_first_seq(field.content);
        if (field.number == 5) {
            Field part;
            while (read_field(&field.content, &part))
                if (part.number == 3)
                    snprintf(reason, sizeof reason, "%.*s", (int)(part.content.end - part.content.at),
                             (const char *)part.content.at);
        }
    }
    if (boot != heard->boot || kind != 1) return;
    heard->is_durable |= is_durable;
    if (reason[0]) memcpy(heard->rejection, reason, sizeof reason);
}

/* ---- callbacks ---- */

static Reader copy_payload(const z_loaned_bytes_t *bytes, z_owned_slice_t *slice) {
    z_bytes_to_slice(bytes, slice);
    const uint8_t *data = z_slice_data(z_loan(*slice));
    return (Reader){data, data + z_slice_len(z_loan(*slice))};
}

static void on_ack(z_loaned_sample_t *sample, void *context) {
    Heard *heard = context;
    z_owned_slice_t slice;
    Reader reader = copy_payload(z_sample_payload(sample), &slice);
    Field field;
    pthread_mutex_lock(&heard->lock);
    while (read_field(&reader, &field))
        if (field.number == 2) read_stream_ack(field.content, heard);
    pthread_cond_broadcast(&heard->changed);
    pthread_mutex_unlock(&heard->lock);
    z_drop(z_move(slice));
}

static void on_alert(z_loaned_sample_t *sample, void *context) {
    Heard *heard = context;
    z_owned_slice_t slice;
    Reader reader = copy_payload(z_sample_payload(sample), &slice);
    Field field;
    bool is_raised = false;
    uint32_t bits = 0;
    while (read_field(&reader, &field)) {
        if (field.number == 3) is_raised = field.value != 0;
        if (field.number == 5) bits = (uint32_t)field.value;
    }
    z_drop(z_move(slice));
    if (!is_raised) return;
    pthread_mutex_lock(&heard->lock);
    memcpy(&heard->alert_mu, &bits, sizeof bits);
    heard->is_alerted = true;
    pthread_cond_broadcast(&heard->changed);
    pthread_mutex_unlock(&heard->lock);
}

static void on_tile(z_loaned_reply_t *reply, void *context) {
    Heard *heard = context;
    z_owned_slice_t slice;
    bool is_tile = z_reply_is_ok(reply);
    Reader reader = copy_payload(is_tile ? z_sample_payload(z_reply_ok(reply))
                                         : z_reply_err_payload(z_reply_err(reply)), &slice);
    if (is_tile) {
        static const char NEEDLE[] = "\"mu_lower\"";  /* with `format=json` each cell has this column once */
        const size_t length = sizeof NEEDLE - 1;
        pthread_mutex_lock(&heard->lock);
        heard->tiles++;
        heard->tile_bytes += (size_t)(reader.end - reader.at);
        for (const uint8_t *at = reader.at; at + length <= reader.end; at++)
            heard->cells += memcmp(at, NEEDLE, length) == 0;
        pthread_mutex_unlock(&heard->lock);
    } else {
        fprintf(stderr, "%.*s\n", (int)(reader.end - reader.at), (const char *)reader.at);
    }
    z_drop(z_move(slice));
}

static void on_last_tile(void *context) {
    Heard *heard = context;
    pthread_mutex_lock(&heard->lock);
    heard->is_answered = true;
    pthread_cond_broadcast(&heard->changed);
    pthread_mutex_unlock(&heard->lock);
}

/* Wait until `*flag` is true, a batch is rejected or the time is over. Return the flag. */
static bool wait_for(Heard *heard, const bool *flag, double seconds) {
    struct timespec until;
    clock_gettime(CLOCK_REALTIME, &until);
    double end = (double)until.tv_sec + 1e-9 * (double)until.tv_nsec + seconds;
    until.tv_sec = (time_t)end;
    until.tv_nsec = (long)(1e9 * (end - floor(end)));
    pthread_mutex_lock(&heard->lock);
    while (!*flag && !heard->rejection[0] && pthread_cond_timedwait(&heard->changed, &heard->lock, &until) == 0) {
    }
    bool found = *flag;
    pthread_mutex_unlock(&heard->lock);
    return found;
}

/* ---- keys ---- */

/* Write the quadkey of a place at zoom 14 as chunks <d4>/<d3>/<d3>/<d4>: its tile. The first three are its region. */
static void write_tile_key(double latitude, double longitude, char key[static 18]) {
    double phi = latitude * PI / 180.0;
    uint32_t side = 1u << ZOOM;
    uint32_t x = (uint32_t)floor((longitude + 180.0) / 360.0 * side);
    uint32_t y = (uint32_t)floor((1.0 - asinh(tan(phi)) / PI) / 2.0 * side);
    int at = 0;
    for (int k = 0; k < ZOOM; k++) {
        int bit = ZOOM - 1 - k;
        if (k == 4 || k == 7 || k == 10) key[at++] = '/';
        key[at++] = (char)('0' + ((x >> bit) & 1) + 2 * ((y >> bit) & 1));
    }
    key[at] = '\0';
}

/* ---- the batch ---- */

static int append_column(char *text, int at, const char *name, double value) {
    at += snprintf(text + at, (size_t)(BATCH_SIZE - at), ",\"%s\":[", name);
    for (int k = 0; k < VISITS; k++)
        at += snprintf(text + at, (size_t)(BATCH_SIZE - at), "%s%.7f", k ? "," : "", value);
    return at + snprintf(text + at, (size_t)(BATCH_SIZE - at), "]");
}

/* Write visits that used nearly all the grip of ice: one per second until now, heading north. */
static void write_batch(const char *vehicle, uint64_t boot, double latitude, double longitude, char text[static BATCH_SIZE]) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    int at = snprintf(text, BATCH_SIZE, "{\"vehicle\":\"%s\",\"boot\":\"%" PRIu64 "\",\"seq\":\"1\",\"enter_time\":[",
                      vehicle, boot);
    for (int k = 0; k < VISITS; k++)
        at += snprintf(text + at, (size_t)(BATCH_SIZE - at), "%s\"%" PRId64 "\"", k ? "," : "",
                       ((int64_t)now.tv_sec - VISITS + 1 + k) * 1000000000 + now.tv_nsec);
    at += snprintf(text + at, (size_t)(BATCH_SIZE - at), "]");
    at = append_column(text, at, "latitude", latitude);
    at = append_column(text, at, "longitude", longitude);
    at = append_column(text, at, "yaw", PI / 2.0);
    at = append_column(text, at, "mu", 0.2);
    at = append_column(text, at, "mu_lower", 0.12);
    at = append_column(text, at, "mu_upper", 0.28);
    at = append_column(text, at, "mu_utilised", 0.19);
    snprintf(text + at, (size_t)(BATCH_SIZE - at), "}");
}

static uint64_t draw_boot(void) {
    uint64_t boot = 0;
    FILE *source = fopen("/dev/urandom", "rb");
    if (source == NULL || fread(&boot, sizeof boot, 1, source) != 1) {
        perror("/dev/urandom");
        exit(1);
    }
    fclose(source);
    return boot >> 1;
}

/* ---- Zenoh ---- */

static void open_session(const char *endpoint, z_owned_session_t *session) {
    z_owned_config_t config;
    z_config_default(&config);
#ifdef USE_ZENOH_C
    char endpoints[KEY_SIZE];
    snprintf(endpoints, sizeof endpoints, "[\"%s\"]", endpoint);
    zc_config_insert_json5(z_loan_mut(config), Z_CONFIG_MODE_KEY, "\"client\"");
    zc_config_insert_json5(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, endpoints);
#else
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, endpoint);
#endif
    if (z_open(session, z_move(config), NULL) < 0) {
        fprintf(stderr, "no router at %s; start one with `gripmap router`\n", endpoint);
        exit(1);
    }
}

static void subscribe(const z_loaned_session_t *session, const char *key, void (*callback)(z_loaned_sample_t *, void *),
                      Heard *heard, z_owned_subscriber_t *subscriber) {
    z_view_keyexpr_t expression;
    z_owned_closure_sample_t closure;
    z_closure(&closure, callback, NULL, heard);
    if (z_view_keyexpr_from_str(&expression, key) < 0 ||
        z_declare_subscriber(session, subscriber, z_loan(expression), z_move(closure), NULL) < 0) {
        fprintf(stderr, "cannot subscribe to %s\n", key);
        exit(1);
    }
}

static void put_json(const z_loaned_session_t *session, const char *key, const char *text) {
    z_view_keyexpr_t expression;
    z_owned_bytes_t payload;
    z_owned_encoding_t encoding;
    z_put_options_t options;
    z_put_options_default(&options);
    z_encoding_from_str(&encoding, "application/json");
    options.encoding = z_move(encoding);
    options.priority = Z_PRIORITY_DATA;
    options.congestion_control = Z_CONGESTION_CONTROL_BLOCK;
    z_bytes_copy_from_str(&payload, text);
    if (z_view_keyexpr_from_str(&expression, key) < 0 ||
        z_put(session, z_loan(expression), z_move(payload), &options) < 0) {
        fprintf(stderr, "cannot publish on %s\n", key);
    }
}

static bool query_tile(const z_loaned_session_t *session, const char *key, Heard *heard, double seconds) {
    z_view_keyexpr_t expression;
    z_owned_closure_reply_t closure;
    z_closure(&closure, on_tile, on_last_tile, heard);
    return z_view_keyexpr_from_str(&expression, key) >= 0 &&
           z_get(session, z_loan(expression), "format=json", z_move(closure), NULL) >= 0 &&
           wait_for(heard, &heard->is_answered, seconds);
}

int main(int count, char **words) {
    if (count != 6) {
        fprintf(stderr, "usage: %s ENDPOINT VEHICLE LATITUDE LONGITUDE SECONDS\n", words[0]);
        return 2;
    }
    const char *vehicle = words[2];
    double latitude = atof(words[3]), longitude = atof(words[4]), patience = atof(words[5]);
    Heard heard = {.lock = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER, .boot = draw_boot()};

    char tile[18], ack_key[KEY_SIZE], alert_key[KEY_SIZE], map_key[KEY_SIZE], observation_key[KEY_SIZE], batch[BATCH_SIZE];
    write_tile_key(latitude, longitude, tile);
    snprintf(ack_key, sizeof ack_key, "gripmap/v1/ack/%s", vehicle);
    snprintf(alert_key, sizeof alert_key, "gripmap/v1/alert/%s", tile);
    snprintf(map_key, sizeof map_key, "gripmap/v1/map/%s", tile);
    snprintf(observation_key, sizeof observation_key, "gripmap/v1/obs/%.12s/%s", tile, vehicle);
    write_batch(vehicle, heard.boot, latitude, longitude, batch);

    z_owned_session_t session;
    z_owned_subscriber_t acks, alerts;
    open_session(words[1], &session);
    subscribe(z_loan(session), ack_key, on_ack, &heard, &acks);
    subscribe(z_loan(session), alert_key, on_alert, &heard, &alerts);

    bool is_settled = false;
    double waited = 0.0;
    for (int retry = FIRST_RETRY_S; !is_settled && !heard.rejection[0] && waited < patience; waited += retry) {
        if (waited > 0.0) retry = retry * 2 < LAST_RETRY_S ? retry * 2 : LAST_RETRY_S;
        put_json(z_loan(session), observation_key, batch);
        is_settled = wait_for(&heard, &heard.is_durable, retry);
    }
    bool is_warned = is_settled && wait_for(&heard, &heard.is_alerted, patience);
    bool is_served = is_warned && query_tile(z_loan(session), map_key, &heard, patience);

    z_drop(z_move(acks));
    z_drop(z_move(alerts));
    z_drop(z_move(session));
    printf("{\"durable\": %s, \"alert_mu\": %.3f, \"tiles\": %d, \"tile_bytes\": %zu, \"cells\": %d}\n",
           is_settled ? "true" : "false", is_warned ? (double)heard.alert_mu : -1.0, heard.tiles, heard.tile_bytes,
           heard.cells);
    if (heard.rejection[0]) fprintf(stderr, "rejected: %s\n", heard.rejection);
    return is_served && heard.tiles > 0 && heard.cells > 0 ? 0 : 1;
}
