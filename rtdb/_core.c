/* _core.c - the Python face of fw_rtdb.h: the types Store, Clock and Edges. It adds types and exceptions, never logic.
 * Limited API of CPython 3.11: one binary serves every later version. */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <sys/mman.h>

#undef Py_RETURN_NONE /* the headers of 3.12 and later take None for immortal, and in 3.11 it is not */
#define Py_RETURN_NONE return Py_NewRef(Py_None)

#include "core/fw_layout.h"

#ifndef FW_SOURCE_HASH
#define FW_SOURCE_HASH ""
#endif

typedef struct { PyObject_HEAD fw_db *db; } Store;
typedef struct { PyObject_HEAD fw_clock_thread *thread; } Clock;
typedef struct { PyObject_HEAD fw_edges *thread; } Edges;

/* Raises what rtdb.errors.of makes of a negative errno. */
static PyObject *fail(int64_t r, const char *call, const char *subject) {
    PyObject *module = PyImport_ImportModule("rtdb.errors");
    if (!module) return NULL;
    PyObject *error = PyObject_CallMethod(module, "of", "iss", (int)-r, call, subject);
    Py_DECREF(module);
    if (!error) return NULL;
    PyErr_SetObject((PyObject *)Py_TYPE(error), error);
    Py_DECREF(error);
    return NULL;
}

static PyObject *fail_object(fw_db *db, int64_t r, const char *call, fw_handle object) {
    fw_object o;
    int known = db && fw_object_get(db, object, &o) == 0;
    return fail(r, call, known ? o.spec.name : "an object that is not there");
}

static int closed(Store *self) {
    if (self->db) return 0;
    fail(-EBADF, "use", "the store");
    return 1;
}

#define NARGS(n) \
    if (closed(self)) return NULL; \
    if (nargs != (n)) { PyErr_Format(PyExc_TypeError, "%s takes %d arguments, got %zd", __func__, n, nargs); return NULL; }
#define FAST PyObject *const *args, Py_ssize_t nargs

static int u32_of(PyObject *o, uint32_t *out) {
    unsigned long v = PyLong_AsUnsignedLong(o);
    if (v == (unsigned long)-1 && PyErr_Occurred()) return -1;
    if (v > UINT32_MAX) { PyErr_SetString(PyExc_OverflowError, "index out of range"); return -1; }
    *out = (uint32_t)v;
    return 0;
}

static int i64_of(PyObject *o, int64_t *out) {
    *out = PyLong_AsLongLong(o);
    return *out == -1 && PyErr_Occurred() ? -1 : 0;
}

/* ((oid, write), ...) -> array; returns the count, -1 with an exception */
static int causes_of(PyObject *o, fw_cause *out) {
    if (!PyTuple_Check(o)) { PyErr_SetString(PyExc_TypeError, "causes are a tuple of (object id, write number)"); return -1; }
    Py_ssize_t n = PyTuple_Size(o);
    if (n > (Py_ssize_t)FW_CAUSES_MAX) { PyErr_Format(PyExc_ValueError, "%zd causes, at most %u", n, FW_CAUSES_MAX); return -1; }
    for (Py_ssize_t i = 0; i < n; i++) {
        PyObject *pair = PyTuple_GetItem(o, i);
        if (!PyTuple_Check(pair) || PyTuple_Size(pair) != 2) {
            PyErr_SetString(PyExc_TypeError, "a cause is a pair: (object id, write number)");
            return -1;
        }
        out[i].oid = PyLong_AsUnsignedLongLong(PyTuple_GetItem(pair, 0));
        out[i].write = PyLong_AsUnsignedLongLong(PyTuple_GetItem(pair, 1));
        if (PyErr_Occurred()) return -1;
    }
    return (int)n;
}

/* Numbers of a specification, none of them cut off to fit: 0, or -1 with an exception. */
static int u32s_of(const long long *from, uint32_t *const *to, int n) {
    for (int i = 0; i < n; i++) {
        if (from[i] < 0 || from[i] > UINT32_MAX) {
            PyErr_Format(PyExc_OverflowError, "%lld is no number from 0 to 4294967295", from[i]);
            return -1;
        }
        *to[i] = (uint32_t)from[i];
    }
    return 0;
}

static int u64_of(PyObject *o, uint64_t *out) {
    *out = PyLong_AsUnsignedLongLong(o);
    return *out == (uint64_t)-1 && PyErr_Occurred() ? -1 : 0;
}

/* (payload, write, t_commit_ns, t_data_ns, causes) of write w; NULL with *error, or with an exception and *error 0 */
static PyObject *sample_or(fw_db *db, fw_handle object, int64_t w, int *error) {
    const void *data;
    fw_info info;
    int r = *error = fw_peek(db, object, (uint64_t)w, &data, &info);
    if (r < 0) return NULL;
    PyObject *payload = PyBytes_FromStringAndSize(NULL, (Py_ssize_t)info.size);
    if (!payload) return NULL;
    fw_copy_out(PyBytes_AsString(payload), data, info.size);
    PyObject *causes = (r = fw_check(db, object, (uint64_t)w)) < 0 ? NULL : PyTuple_New(info.n_causes);
    PyObject *sample = causes ? PyTuple_New(5) : NULL;
    if (!sample) {
        Py_XDECREF(causes);
        Py_DECREF(payload);
        *error = r < 0 ? r : 0;
        return NULL;
    }
    for (uint32_t i = 0; i < info.n_causes; i++)
        PyTuple_SetItem(causes, i, Py_BuildValue("(KK)", info.causes[i].oid, info.causes[i].write));
    PyTuple_SetItem(sample, 0, payload);
    PyTuple_SetItem(sample, 1, PyLong_FromLongLong(w));
    PyTuple_SetItem(sample, 2, PyLong_FromLongLong(info.t_commit_ns));
    PyTuple_SetItem(sample, 3, PyLong_FromLongLong(info.t_data_ns));
    PyTuple_SetItem(sample, 4, causes);
    return sample;
}

static PyObject *sample_of(fw_db *db, fw_handle object, int64_t w) {
    int error;
    PyObject *sample = sample_or(db, object, w, &error);
    return sample || !error ? sample : fail_object(db, error, "read", object);
}

/* -- stores ----------------------------------------------------------------------------------------------------- */

static PyObject *instance(PyObject *module, const char *name) {
    PyObject *type = PyObject_GetAttrString(module, name);
    if (!type) return NULL;
    allocfunc alloc = (allocfunc)PyType_GetSlot((PyTypeObject *)type, Py_tp_alloc);
    PyObject *self = alloc((PyTypeObject *)type, 0);
    Py_DECREF(type);
    return self;
}

static PyObject *wrap(PyObject *module, fw_db *db) {
    Store *self = (Store *)instance(module, "Store");
    if (!self) { fw_close(db); return NULL; }
    self->db = db;
    return (PyObject *)self;
}

static PyObject *core_create(PyObject *module, PyObject *args) {
    const char *name;
    fw_opts o = {0};
    int deterministic;
    long long n[3];
    if (!PyArg_ParseTuple(args, "zKLLLLLp", &name, &o.size, &n[0], &n[1], &n[2], &o.tick_ns, &o.t0_ns, &deterministic) ||
        u32s_of(n, (uint32_t *[]){&o.max_objects, &o.max_components, &o.clock}, 3) < 0) return NULL;
    o.deterministic = (uint32_t)deterministic;
    fw_db *db;
    int r = fw_create(&db, name, &o);
    return r < 0 ? fail(r, "create", name ? name : "a private store") : wrap(module, db);
}

static PyObject *core_attach(PyObject *module, PyObject *args) {
    const char *name;
    if (!PyArg_ParseTuple(args, "s", &name)) return NULL;
    fw_db *db;
    int r = fw_attach(&db, name);
    return r < 0 ? fail(r, "attach", name) : wrap(module, db);
}

static PyObject *core_lock_memory(PyObject *Py_UNUSED(module), PyObject *Py_UNUSED(ignored)) { /* errno, 0 when done */
    return PyLong_FromLong(mlockall(MCL_CURRENT | MCL_FUTURE) == 0 ? 0 : errno);
}

static PyObject *store_bears_name(Store *self, PyObject *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyBool_FromLong(fw_bears_name(self->db));
}

static PyObject *store_close(Store *self, PyObject *Py_UNUSED(ignored)) {
    if (self->db) fw_close(self->db);
    self->db = NULL;
    Py_RETURN_NONE;
}

static PyObject *store_forget(Store *self, PyObject *Py_UNUSED(ignored)) {
    if (self->db) fw_forget(self->db);
    self->db = NULL;
    Py_RETURN_NONE;
}

static void store_dealloc(Store *self) {
    PyTypeObject *type = Py_TYPE((PyObject *)self);
    if (self->db) fw_close(self->db);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyObject *store_save(Store *self, PyObject *Py_UNUSED(ignored)) {
    if (closed(self)) return NULL;
    size_t n = fw_image_size(self->db);
    if (!n) return fail(-EPERM, "save", "a shared store");
    PyObject *image = PyBytes_FromStringAndSize(NULL, (Py_ssize_t)n);
    if (image) fw_save(self->db, PyBytes_AsString(image), n);
    return image;
}

static PyObject *store_restore(Store *self, PyObject *image) {
    char *data;
    Py_ssize_t n;
    if (closed(self) || PyBytes_AsStringAndSize(image, &data, &n) < 0) return NULL;
    int r = fw_restore(self->db, data, (size_t)n);
    if (r < 0) return fail(r, "restore", "the store from this image");
    Py_RETURN_NONE;
}

static PyObject *store_memory(Store *self, PyObject *Py_UNUSED(ignored)) { /* bytes of the heap, unused ones */
    uint64_t size, unused;
    if (closed(self)) return NULL;
    fw_memory(self->db, &size, &unused);
    return Py_BuildValue("(KK)", size, unused);
}

/* -- directory -------------------------------------------------------------------------------------------------- */

static PyObject *store_join(Store *self, PyObject *args) {
    const char *name;
    int participant;
    fw_join_opts o = {0};
    long long n[2];
    if (closed(self) || !PyArg_ParseTuple(args, "spLLs", &name, &participant, &n[0], &n[1], &o.version) ||
        u32s_of(n, (uint32_t *[]){&o.every, &o.phase}, 2) < 0) return NULL;
    o.participant = (uint32_t)participant;
    int r = fw_join(self->db, name, &o);
    return r < 0 ? fail(r, "join", name) : PyLong_FromLong(r);
}

static PyObject *store_leave(Store *self, FAST) {
    uint32_t component;
    NARGS(1)
    if (u32_of(args[0], &component) < 0) return NULL;
    int r = fw_leave(self->db, component);
    if (r < 0) return fail(r, "leave", "a component");
    Py_RETURN_NONE;
}

static PyObject *store_component(Store *self, FAST) {
    uint32_t i;
    fw_component c;
    NARGS(1)
    if (u32_of(args[0], &i) < 0) return NULL;
    int r = fw_component_get(self->db, i, &c);
    if (r < 0) return fail(r, "look up", "a component");
    return Py_BuildValue("(sLNKNKsII)", c.name, c.pid, PyBool_FromLong(c.alive), c.done, PyBool_FromLong(c.participant), c.missed,
                         c.version, c.every, c.phase);
}

static PyObject *store_n_components(Store *self, PyObject *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromUnsignedLong(fw_n_components(self->db));
}

static PyObject *store_alive_at(Store *self, FAST) { /* component, cycle */
    uint32_t component;
    uint64_t cycle;
    NARGS(2)
    if (u32_of(args[0], &component) < 0 || u64_of(args[1], &cycle) < 0) return NULL;
    int r = fw_alive_at(self->db, component, cycle);
    return r < 0 ? fail(r, "look up", "the life of a component") : PyBool_FromLong(r);
}

static PyObject *store_status(Store *self, PyObject *args) { /* component, state, text */
    unsigned component, state;
    const char *text;
    if (closed(self) || !PyArg_ParseTuple(args, "IIs", &component, &state, &text)) return NULL;
    int r = fw_status(self->db, component, (uint8_t)(state > 255 ? 255 : state), text);
    if (r < 0) return fail(r, "set the status of", "a component");
    Py_RETURN_NONE;
}

static PyObject *store_add_schema(Store *self, PyObject *args) {
    const char *text;
    Py_ssize_t n;
    if (closed(self) || !PyArg_ParseTuple(args, "s#", &text, &n)) return NULL;
    int r = n > INT32_MAX ? -ENOSPC : fw_schema_add(self->db, text, (uint32_t)n);
    return r < 0 ? fail(r, "add", "a schema") : PyLong_FromLong(r);
}

static PyObject *store_schema(Store *self, FAST) {
    uint32_t i, n;
    const char *text;
    NARGS(1)
    if (u32_of(args[0], &i) < 0) return NULL;
    int r = fw_schema_get(self->db, i, &text, &n);
    return r < 0 ? fail(r, "look up", "a schema") : PyUnicode_DecodeUTF8(text, (Py_ssize_t)n, "replace");
}

static PyObject *store_insert(Store *self, PyObject *args) {
    const char *name;
    fw_spec s = {0};
    uint32_t *const to[] = {&s.component, &s.schema, &s.size, &s.n_slots, &s.every, &s.phase, &s.flags, &s.n_causes};
    long long n[8];
    if (closed(self) || !PyArg_ParseTuple(args, "sLLLLLLLLKLLL", &name, &n[0], &n[1], &n[2], &n[3], &n[4], &n[5], &n[6], &n[7],
                                          &s.parent, &s.t_history_ns, &s.min_cycle_ns, &s.max_age_ns) ||
        u32s_of(n, to, 8) < 0) return NULL;
    if (strlen(name) >= FW_NAME_MAX) return fail(-ENAMETOOLONG, "insert", name);
    strncpy(s.name, name, FW_NAME_MAX - 1);
    fw_handle h = fw_insert(self->db, &s);
    return h < 0 ? fail(h, "insert", name) : PyLong_FromLongLong(h);
}

static PyObject *store_delete(Store *self, FAST) { /* object */
    fw_handle h;
    NARGS(1)
    if (i64_of(args[0], &h) < 0) return NULL;
    int r = fw_delete(self->db, h);
    if (r < 0) return fail_object(self->db, r, "delete", h);
    Py_RETURN_NONE;
}

static PyObject *store_find(Store *self, PyObject *args) {
    const char *name;
    if (closed(self) || !PyArg_ParseTuple(args, "s", &name)) return NULL;
    fw_handle h = fw_find(self->db, name);
    return h < 0 ? fail(h, "find", name) : PyLong_FromLongLong(h);
}

static PyObject *store_entries(Store *self, PyObject *Py_UNUSED(ignored)) { /* handles, of the deleted ones too */
    PyObject *list = closed(self) ? NULL : PyList_New(0);
    for (uint32_t i = 0, n = list ? fw_n_entries(self->db) : 0; i < n; i++) {
        fw_handle h = fw_entry(self->db, i);
        PyObject *o = h < 0 ? NULL : PyLong_FromLongLong(h);
        if (h >= 0 && (!o || PyList_Append(list, o) < 0)) { Py_XDECREF(o); Py_DECREF(list); return NULL; }
        Py_XDECREF(o);
    }
    return list;
}

static PyObject *store_object(Store *self, FAST) {
    fw_handle h;
    fw_object o;
    NARGS(1)
    if (i64_of(args[0], &h) < 0) return NULL;
    int r = fw_object_get(self->db, h, &o);
    if (r < 0) return fail_object(self->db, r, "look up", h);
    return Py_BuildValue("(sKIIIIIIIIKKKLLLLLL)", o.spec.name, o.oid, o.spec.component, o.spec.schema, o.spec.size, o.spec.n_slots,
                         o.spec.every, o.spec.phase, o.spec.flags, o.spec.n_causes, o.spec.parent, o.head, o.refused,
                         o.t_insert_ns, o.t_delete_ns, o.spec.t_history_ns, o.spec.min_cycle_ns, o.spec.max_age_ns, o.t_data_ns);
}

/* -- writing and reading ------------------------------------------------------------------------------------------ */

static PyObject *store_write(Store *self, FAST) { /* object, payload, t_data_ns, causes */
    fw_handle object;
    fw_cause causes[FW_CAUSES_MAX];
    char *data;
    Py_ssize_t n;
    int64_t t;
    NARGS(4)
    if (i64_of(args[0], &object) < 0 || PyBytes_AsStringAndSize(args[1], &data, &n) < 0 || i64_of(args[2], &t) < 0) return NULL;
    int n_causes = causes_of(args[3], causes);
    if (n_causes < 0) return NULL;
    int64_t w = n > UINT32_MAX ? -EMSGSIZE : fw_write(self->db, object, data, (uint32_t)n, t, causes, (uint32_t)n_causes);
    return w < 0 ? fail_object(self->db, w, "write", object) : PyLong_FromLongLong(w);
}

static PyObject *store_not_before(Store *self, FAST) { /* object, t_data_ns -> the time, or that of the newest write if later */
    fw_handle object;
    int64_t t;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || i64_of(args[1], &t) < 0) return NULL;
    return PyLong_FromLongLong(fw_not_before(self->db, object, t));
}

static PyObject *store_begin(Store *self, FAST) { /* object -> writable memory of one slot, until commit */
    fw_handle object;
    void *slot;
    fw_ref *ref;
    NARGS(1)
    if (i64_of(args[0], &object) < 0) return NULL;
    int r = fw_write_begin(self->db, object, &slot);
    if (r < 0 || (r = fw_ref_get(self->db, object, &ref)) < 0) return fail_object(self->db, r, "write", object);
    return PyMemoryView_FromMemory(slot, (Py_ssize_t)ref->size, PyBUF_WRITE);
}

static PyObject *store_commit(Store *self, FAST) { /* object, size, t_data_ns, causes */
    fw_handle object;
    uint32_t n;
    int64_t t;
    fw_cause causes[FW_CAUSES_MAX];
    NARGS(4)
    if (i64_of(args[0], &object) < 0 || u32_of(args[1], &n) < 0 || i64_of(args[2], &t) < 0) return NULL;
    int n_causes = causes_of(args[3], causes);
    if (n_causes < 0) return NULL;
    int64_t w = fw_write_commit(self->db, object, n, t, causes, (uint32_t)n_causes);
    return w < 0 ? fail_object(self->db, w, "write", object) : PyLong_FromLongLong(w);
}

static PyObject *found(Store *self, fw_handle object, int64_t w) { /* a sample, None for no write, or an exception */
    if (w == 0 || w == -EAGAIN) Py_RETURN_NONE;
    return w < 0 ? fail_object(self->db, w, "read", object) : sample_of(self->db, object, w);
}

static PyObject *number(Store *self, fw_handle object, int64_t w) { /* a write number, 0 for none yet, or an exception */
    if (w == -EAGAIN) w = 0;
    return w < 0 ? fail_object(self->db, w, "read", object) : PyLong_FromLongLong(w);
}

static PyObject *store_read(Store *self, FAST) { /* object, write */
    fw_handle object;
    int64_t w;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || i64_of(args[1], &w) < 0) return NULL;
    return sample_of(self->db, object, w < 0 ? 0 : w);
}

static PyObject *store_peek(Store *self, FAST) { /* object, write -> read-only memory, t_commit_ns, t_data_ns: see fw_peek */
    fw_handle object;
    int64_t w;
    const void *data;
    fw_info info;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || i64_of(args[1], &w) < 0) return NULL;
    int r = fw_peek(self->db, object, (uint64_t)(w < 0 ? 0 : w), &data, &info);
    if (r < 0) return fail_object(self->db, r, "read", object);
    PyObject *memory = PyMemoryView_FromMemory((char *)(uintptr_t)data, (Py_ssize_t)info.size, PyBUF_READ);
    return memory ? Py_BuildValue("(NLL)", memory, info.t_commit_ns, info.t_data_ns) : NULL;
}

static PyObject *store_check(Store *self, FAST) { /* object, write: AgedOut, Deleted, or nothing */
    fw_handle object;
    int64_t w;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || i64_of(args[1], &w) < 0) return NULL;
    int r = fw_check(self->db, object, (uint64_t)w);
    if (r < 0) return fail_object(self->db, r, "read", object);
    Py_RETURN_NONE;
}

static PyObject *store_writer(Store *self, FAST) { /* object, write -> component that wrote it */
    fw_handle object;
    int64_t w;
    const void *data;
    fw_info info;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || i64_of(args[1], &w) < 0) return NULL;
    int r = fw_peek(self->db, object, (uint64_t)(w < 0 ? 0 : w), &data, &info);
    return r < 0 ? fail_object(self->db, r, "read", object) : PyLong_FromUnsignedLong(info.writer);
}

static PyObject *store_visible(Store *self, FAST) { /* object, cycle */
    fw_handle object;
    uint64_t cycle;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || u64_of(args[1], &cycle) < 0) return NULL;
    return found(self, object, fw_visible(self->db, object, cycle));
}

static PyObject *store_visible_write(Store *self, FAST) { /* object, cycle -> write number, 0 for none yet */
    fw_handle object;
    uint64_t cycle;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || u64_of(args[1], &cycle) < 0) return NULL;
    return number(self, object, fw_visible(self->db, object, cycle));
}

static PyObject *store_latest(Store *self, FAST) { /* object */
    fw_handle object;
    NARGS(1)
    if (i64_of(args[0], &object) < 0) return NULL;
    for (int i = 0;; i++) { /* a flat-out writer may lap the reader now and then */
        int64_t w = fw_newest(self->db, object);
        int error;
        if (w <= 0) return found(self, object, w);
        PyObject *sample = sample_or(self->db, object, w, &error);
        if (sample || !error) return sample;
        if (error != -ESTALE || i == 1000) return fail_object(self->db, error, "read", object);
    }
}

static PyObject *store_as_of(Store *self, FAST) { /* object, t_ns -> write number, 0 for none yet */
    fw_handle object;
    int64_t t;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || i64_of(args[1], &t) < 0) return NULL;
    return number(self, object, fw_as_of(self->db, object, t));
}

static PyObject *store_as_of_data(Store *self, FAST) { /* object, t_ns -> write number, 0 for none yet */
    fw_handle object;
    int64_t t;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || i64_of(args[1], &t) < 0) return NULL;
    return number(self, object, fw_as_of_data(self->db, object, t));
}

static PyObject *store_next(Store *self, FAST) { /* object, after -> (sample, lost), or None */
    fw_handle object;
    uint64_t after, lost;
    NARGS(2)
    if (i64_of(args[0], &object) < 0 || u64_of(args[1], &after) < 0) return NULL;
    for (int i = 0;; i++) { /* a flat-out writer may take the slot between finding and reading it: then it is lost too */
        int64_t w = fw_next(self->db, object, after, &lost);
        int error;
        if (w == -EAGAIN) Py_RETURN_NONE;
        if (w < 0) return fail_object(self->db, w, "read", object);
        PyObject *sample = sample_or(self->db, object, w, &error);
        if (sample) return Py_BuildValue("(NK)", sample, lost);
        if (!error) return NULL;
        if (error != -ESTALE || i == 1000) return fail_object(self->db, error, "read", object);
    }
}

static PyObject *store_changed(Store *self, PyObject *Py_UNUSED(ignored)) { /* [(object, sample)] of the latest tick */
    if (closed(self)) return NULL;
    PyObject *list = PyList_New(0);
    uint32_t n = list ? fw_n_entries(self->db) : 0;
    for (uint32_t i = 0; i < n; i++) {
        fw_handle h = fw_entry(self->db, i);
        int64_t w = h < 0 ? 0 : fw_changed(self->db, h);
        if (w == 0 || w == -EACCES || w == -EIDRM) continue;
        PyObject *sample = w < 0 ? fail_object(self->db, w, "read", h) : sample_of(self->db, h, w);
        PyObject *pair = sample ? Py_BuildValue("(LN)", h, sample) : NULL;
        if (!pair || PyList_Append(list, pair) < 0) { Py_XDECREF(pair); Py_DECREF(list); return NULL; }
        Py_DECREF(pair);
    }
    return list;
}

/* -- clock -------------------------------------------------------------------------------------------------------- */

static PyObject *store_tick(Store *self, PyObject *Py_UNUSED(ignored)) {
    if (closed(self)) return NULL;
    int64_t c = fw_tick(self->db);
    return c < 0 ? fail(c, "tick", "the clock") : PyLong_FromLongLong(c);
}

#define UNSIGNED(name, call) \
    static PyObject *store_##name(Store *self, void *Py_UNUSED(ignored)) { return closed(self) ? NULL : PyLong_FromUnsignedLongLong(call(self->db)); }
#define SIGNED(name, call) \
    static PyObject *store_##name(Store *self, void *Py_UNUSED(ignored)) { return closed(self) ? NULL : PyLong_FromLongLong(call(self->db)); }
UNSIGNED(cycle, fw_cycle)
UNSIGNED(id, fw_store_id)
UNSIGNED(version, fw_directory_version)
SIGNED(now_ns, fw_now_ns)
SIGNED(tick_ns, fw_tick_ns)
SIGNED(t0_ns, fw_t0_ns)

static PyObject *store_clock_state(Store *self, PyObject *Py_UNUSED(ignored)) {
    fw_clock_state c;
    if (closed(self)) return NULL;
    fw_clock_get(self->db, &c);
    PyObject *bins = PyTuple_New(FW_BINS);
    for (uint32_t k = 0; bins && k < FW_BINS; k++) PyTuple_SetItem(bins, k, PyLong_FromUnsignedLong(c.lateness_us[k]));
    return bins ? Py_BuildValue("(INLKKKLN)", c.kind, PyBool_FromLong(c.alive), c.pid, c.cycle, c.skipped, c.takeovers, c.late_ns, bins)
                : NULL;
}

static PyObject *store_take_clock(Store *self, PyObject *Py_UNUSED(ignored)) {
    if (closed(self)) return NULL;
    int r = fw_clock_take(self->db);
    if (r < 0) return fail(r, "take", "the clock");
    Py_RETURN_NONE;
}

static PyObject *store_mark_dead(Store *self, PyObject *Py_UNUSED(ignored)) { /* False: a living clock does that */
    if (closed(self)) return NULL;
    int r = fw_mark_dead(self->db);
    return r < 0 && r != -EBUSY ? fail(r, "mark", "the dead") : PyBool_FromLong(r == 0);
}

static PyObject *store_done(Store *self, FAST) { /* component, cycle */
    uint32_t component;
    uint64_t cycle;
    NARGS(2)
    if (u32_of(args[0], &component) < 0 || u64_of(args[1], &cycle) < 0) return NULL;
    int r = fw_done(self->db, component, cycle);
    if (r < 0) return fail(r, "report done", "a component");
    Py_RETURN_NONE;
}

typedef int64_t (*wait_call)(fw_db *, int64_t, uint64_t, int64_t); /* what, number, deadline or timeout */
static int64_t wait_cycle(fw_db *db, int64_t what, uint64_t n, int64_t timeout) { (void)what; return fw_wait_cycle(db, n, timeout); }
static int64_t wait_done(fw_db *db, int64_t what, uint64_t n, int64_t timeout) { (void)what; return fw_wait_done(db, n, timeout); }
static int64_t wait_directory(fw_db *db, int64_t what, uint64_t n, int64_t timeout) { (void)what; return fw_wait_directory(db, n, timeout); }
static int64_t wait_step(fw_db *db, int64_t what, uint64_t n, int64_t timeout) { (void)n; return fw_step(db, (uint32_t)what, timeout); }

/* Waits without the interpreter's lock; Ctrl-C ends it. Returns the result, or None after the timeout. */
static PyObject *waiting(Store *self, wait_call call, int64_t what, uint64_t n, PyObject *timeout_ns, const char *subject) {
    int64_t timeout, r;
    if (PyErr_Occurred() || i64_of(timeout_ns, &timeout) < 0) return NULL;
    int64_t deadline = fw_platform_monotonic_ns() + timeout;
    for (;;) { /* in slices, so that a signal just before the system call is noticed too */
        int64_t left = deadline - fw_platform_monotonic_ns(), slice = left < 100000000 ? left : 100000000;
        Py_BEGIN_ALLOW_THREADS
        r = call(self->db, what, n, slice);
        Py_END_ALLOW_THREADS
        if (PyErr_CheckSignals() < 0) return NULL;
        if (r != -EINTR && (r != -ETIMEDOUT || slice == left)) break;
    }
    if (r == -ETIMEDOUT) Py_RETURN_NONE;
    return r < 0 ? fail(r, "wait for", subject) : PyLong_FromLongLong(r);
}

static PyObject *store_wait_cycle(Store *self, FAST) { /* after, timeout_ns */
    NARGS(2)
    return waiting(self, wait_cycle, 0, PyLong_AsUnsignedLongLong(args[0]), args[1], "a cycle");
}
static PyObject *store_wait_done(Store *self, FAST) { /* cycle, timeout_ns */
    NARGS(2)
    return waiting(self, wait_done, 0, PyLong_AsUnsignedLongLong(args[0]), args[1], "the participants");
}
static PyObject *store_wait_directory(Store *self, FAST) { /* version, timeout_ns */
    NARGS(2)
    return waiting(self, wait_directory, 0, PyLong_AsUnsignedLongLong(args[0]), args[1], "a change of the directory");
}
static PyObject *store_step(Store *self, FAST) { /* component, timeout_ns */
    NARGS(2)
    return waiting(self, wait_step, PyLong_AsLongLong(args[0]), 0, args[1], "a cycle");
}

static PyObject *store_wait_write(Store *self, FAST) { /* object, after, t_ns of the store's time */
    fw_handle object;
    uint64_t after;
    int64_t t, r;
    NARGS(3)
    if (i64_of(args[0], &object) < 0 || u64_of(args[1], &after) < 0 || i64_of(args[2], &t) < 0) return NULL;
    int64_t dead_since_ns = 0, limit = fw_host_limit(self->db, t);
    do { /* in slices, so that a signal just before the system call is noticed too */
        Py_BEGIN_ALLOW_THREADS
        r = fw_wait_write_until(self->db, object, after, t, fw_platform_monotonic_ns() + 100000000, &dead_since_ns);
        Py_END_ALLOW_THREADS
        if (PyErr_CheckSignals() < 0) return NULL;
        if (r == -EAGAIN && fw_platform_monotonic_ns() >= limit) r = -ETIMEDOUT;
    } while (r == -EINTR || r == -EAGAIN);
    if (r == -ETIMEDOUT) Py_RETURN_NONE;
    return r < 0 ? fail_object(self->db, r, "wait for", object) : PyLong_FromLongLong(r);
}

/* -- a clock that runs by itself ------------------------------------------------------------------------------------ */

static PyObject *core_start_clock(PyObject *module, PyObject *args) { /* name, (component, ...) */
    const char *name, *names[64];
    PyObject *wait_for;
    if (!PyArg_ParseTuple(args, "sO", &name, &wait_for)) return NULL;
    Py_ssize_t n = PyTuple_Size(wait_for);
    if (n < 0) return NULL;
    if (n > 64) return PyErr_Format(PyExc_ValueError, "%zd components to wait for, at most 64", n);
    for (Py_ssize_t i = 0; i < n; i++)
        if (!(names[i] = PyUnicode_AsUTF8AndSize(PyTuple_GetItem(wait_for, i), NULL))) return NULL;
    Clock *self = (Clock *)instance(module, "Clock");
    if (!self) return NULL;
    int r = fw_clock_start(&self->thread, name, names, (uint32_t)n);
    if (r == 0) return (PyObject *)self;
    self->thread = NULL;
    Py_DECREF(self);
    return fail(r, "start", "the clock: a stepped store is ticked by whoever holds it");
}

static PyObject *clock_stop(Clock *self, PyObject *Py_UNUSED(ignored)) {
    int r = 0;
    fw_clock_thread *thread = self->thread;
    self->thread = NULL;
    if (thread) {
        Py_BEGIN_ALLOW_THREADS
        r = fw_clock_stop(thread);
        Py_END_ALLOW_THREADS
    }
    if (r < 0) return fail(r, "run", "the clock");
    Py_RETURN_NONE;
}

static PyObject *clock_forget(Clock *self, PyObject *Py_UNUSED(ignored)) { /* in a forked child, which has no such thread */
    if (self->thread) fw_clock_forget(self->thread);
    self->thread = NULL;
    Py_RETURN_NONE;
}

static void clock_dealloc(Clock *self) {
    PyTypeObject *type = Py_TYPE((PyObject *)self);
    if (self->thread) fw_clock_stop(self->thread);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

/* -- cycles as a file descriptor ------------------------------------------------------------------------------------ */

static PyObject *core_start_edges(PyObject *module, PyObject *args) { /* name, after */
    const char *name;
    unsigned long long after;
    if (!PyArg_ParseTuple(args, "sK", &name, &after)) return NULL;
    Edges *self = (Edges *)instance(module, "Edges");
    if (!self) return NULL;
    int r = fw_edges_start(&self->thread, name, after);
    if (r == 0) return (PyObject *)self;
    self->thread = NULL;
    Py_DECREF(self);
    return fail(r, "wait for cycles of", name);
}

static PyObject *edges_fileno(Edges *self, PyObject *Py_UNUSED(ignored)) { return PyLong_FromLong(self->thread ? fw_edges_fd(self->thread) : -1); }

static PyObject *edges_stop(Edges *self, PyObject *Py_UNUSED(ignored)) {
    fw_edges *thread = self->thread;
    self->thread = NULL;
    if (thread) {
        Py_BEGIN_ALLOW_THREADS
        fw_edges_stop(thread);
        Py_END_ALLOW_THREADS
    }
    Py_RETURN_NONE;
}

static PyObject *edges_forget(Edges *self, PyObject *Py_UNUSED(ignored)) { /* in a forked child, which has no such thread */
    if (self->thread) fw_edges_forget(self->thread);
    self->thread = NULL;
    Py_RETURN_NONE;
}

static void edges_dealloc(Edges *self) {
    PyTypeObject *type = Py_TYPE((PyObject *)self);
    if (self->thread) fw_edges_stop(self->thread);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

/* -- module ------------------------------------------------------------------------------------------------------- */

#define METHOD(name, flags) {#name, (PyCFunction)(void (*)(void))store_##name, flags, NULL}
static PyMethodDef methods[] = {
    METHOD(close, METH_NOARGS), METHOD(bears_name, METH_NOARGS), METHOD(forget, METH_NOARGS), METHOD(save, METH_NOARGS), METHOD(restore, METH_O),
    METHOD(memory, METH_NOARGS), METHOD(join, METH_VARARGS), METHOD(leave, METH_FASTCALL), METHOD(component, METH_FASTCALL),
    METHOD(n_components, METH_NOARGS), METHOD(alive_at, METH_FASTCALL), METHOD(status, METH_VARARGS),
    METHOD(add_schema, METH_VARARGS), METHOD(schema, METH_FASTCALL), METHOD(insert, METH_VARARGS), METHOD(delete, METH_FASTCALL),
    METHOD(find, METH_VARARGS), METHOD(entries, METH_NOARGS), METHOD(object, METH_FASTCALL), METHOD(write, METH_FASTCALL),
    METHOD(not_before, METH_FASTCALL), METHOD(begin, METH_FASTCALL), METHOD(commit, METH_FASTCALL), METHOD(read, METH_FASTCALL), METHOD(peek, METH_FASTCALL),
    METHOD(check, METH_FASTCALL), METHOD(writer, METH_FASTCALL), METHOD(visible, METH_FASTCALL),
    METHOD(visible_write, METH_FASTCALL), METHOD(latest, METH_FASTCALL), METHOD(as_of, METH_FASTCALL),
    METHOD(as_of_data, METH_FASTCALL), METHOD(next, METH_FASTCALL), METHOD(changed, METH_NOARGS), METHOD(tick, METH_NOARGS),
    METHOD(clock_state, METH_NOARGS), METHOD(take_clock, METH_NOARGS), METHOD(mark_dead, METH_NOARGS),
    METHOD(done, METH_FASTCALL), METHOD(wait_cycle, METH_FASTCALL), METHOD(wait_done, METH_FASTCALL),
    METHOD(wait_directory, METH_FASTCALL), METHOD(wait_write, METH_FASTCALL), METHOD(step, METH_FASTCALL), {NULL, NULL, 0, NULL}};

#define GETTER(name) {#name, (getter)store_##name, NULL, NULL, NULL}
static PyGetSetDef getters[] = {GETTER(cycle), GETTER(now_ns), GETTER(tick_ns), GETTER(t0_ns), GETTER(id), GETTER(version),
                                {NULL, NULL, NULL, NULL, NULL}};

static PyType_Slot store_slots[] = {{Py_tp_dealloc, (void *)store_dealloc}, {Py_tp_methods, methods}, {Py_tp_getset, getters}, {0, NULL}};
static PyType_Spec store_spec = {"rtdb._core.Store", sizeof(Store), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, store_slots};

static PyMethodDef clock_methods[] = {{"stop", (PyCFunction)(void (*)(void))clock_stop, METH_NOARGS, NULL},
                                      {"forget", (PyCFunction)(void (*)(void))clock_forget, METH_NOARGS, NULL}, {NULL, NULL, 0, NULL}};
static PyType_Slot clock_slots[] = {{Py_tp_dealloc, (void *)clock_dealloc}, {Py_tp_methods, clock_methods}, {0, NULL}};
static PyType_Spec clock_spec = {"rtdb._core.Clock", sizeof(Clock), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, clock_slots};

static PyMethodDef edges_methods[] = {{"fileno", (PyCFunction)(void (*)(void))edges_fileno, METH_NOARGS, NULL},
                                      {"stop", (PyCFunction)(void (*)(void))edges_stop, METH_NOARGS, NULL},
                                      {"forget", (PyCFunction)(void (*)(void))edges_forget, METH_NOARGS, NULL}, {NULL, NULL, 0, NULL}};
static PyType_Slot edges_slots[] = {{Py_tp_dealloc, (void *)edges_dealloc}, {Py_tp_methods, edges_methods}, {0, NULL}};
static PyType_Spec edges_spec = {"rtdb._core.Edges", sizeof(Edges), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, edges_slots};

static PyMethodDef functions[] = {{"create", core_create, METH_VARARGS, NULL}, {"attach", core_attach, METH_VARARGS, NULL},
                                  {"start_clock", core_start_clock, METH_VARARGS, NULL}, {"start_edges", core_start_edges, METH_VARARGS, NULL},
                                  {"lock_memory", core_lock_memory, METH_NOARGS, NULL}, {NULL, NULL, 0, NULL}};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "rtdb._core", "The store's C core.", -1, functions, NULL, NULL, NULL, NULL};

static int add_type(PyObject *m, const char *name, PyType_Spec *spec) {
    PyObject *type = PyType_FromSpec(spec);
    int r = type ? PyModule_AddObjectRef(m, name, type) : -1;
    Py_XDECREF(type);
    return r;
}

PyMODINIT_FUNC PyInit__core(void) {
    PyObject *m = PyModule_Create(&module);
    if (!m || add_type(m, "Store", &store_spec) < 0 || add_type(m, "Clock", &clock_spec) < 0 || add_type(m, "Edges", &edges_spec) < 0 ||
        PyModule_AddStringConstant(m, "SOURCE_HASH", FW_SOURCE_HASH) < 0) { Py_XDECREF(m); return NULL; }
    return m;
}
