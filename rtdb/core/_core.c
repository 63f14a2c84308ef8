/* _core.c - the Python face of fw_rtdb.h: one type, Store. It adds types and exceptions, never logic.
 * Limited API of CPython 3.11: one binary serves every later version. */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>

#include "fw_layout.h"

#ifndef FW_SOURCE_HASH
#define FW_SOURCE_HASH ""
#endif

typedef struct { PyObject_HEAD fw_db *db; } Store;

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

static PyObject *fail_object(fw_db *db, int64_t r, const char *call, uint32_t object) {
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

/* ((oid, write), ...) -> array; returns the count, -1 with an exception */
static int causes_of(PyObject *o, fw_cause *out) {
    Py_ssize_t n = PyTuple_Size(o);
    if (n < 0) return -1;
    if (n > (Py_ssize_t)FW_CAUSES_MAX) { PyErr_Format(PyExc_ValueError, "%zd causes, at most %u", n, FW_CAUSES_MAX); return -1; }
    for (Py_ssize_t i = 0; i < n; i++) {
        PyObject *pair = PyTuple_GetItem(o, i);
        if (!pair || PyTuple_Size(pair) != 2) return -1;
        out[i].oid = PyLong_AsUnsignedLongLong(PyTuple_GetItem(pair, 0));
        out[i].write = PyLong_AsUnsignedLongLong(PyTuple_GetItem(pair, 1));
        if (PyErr_Occurred()) return -1;
    }
    return (int)n;
}

/* (payload, write, t_commit_ns, t_data_ns, causes) of write w; NULL with an exception */
static PyObject *sample_of(fw_db *db, uint32_t object, int64_t w) {
    const void *data;
    fw_info info;
    int r = fw_peek(db, object, (uint64_t)w, &data, &info);
    if (r < 0) return fail_object(db, r, "read", object);
    PyObject *payload = PyBytes_FromStringAndSize(NULL, (Py_ssize_t)info.size);
    if (!payload) return NULL;
    fw_copy_out(PyBytes_AsString(payload), data, info.size);
    PyObject *causes = (r = fw_check(db, object, (uint64_t)w)) < 0 ? NULL : PyTuple_New(info.n_causes);
    PyObject *sample = causes ? PyTuple_New(5) : NULL;
    if (!sample) {
        Py_XDECREF(causes);
        Py_DECREF(payload);
        return r < 0 ? fail_object(db, r, "read", object) : NULL;
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

/* -- stores ----------------------------------------------------------------------------------------------------- */

static PyObject *wrap(PyObject *module, fw_db *db) {
    PyObject *type = PyObject_GetAttrString(module, "Store");
    if (!type) { fw_close(db); return NULL; }
    allocfunc alloc = (allocfunc)PyType_GetSlot((PyTypeObject *)type, Py_tp_alloc);
    Store *self = (Store *)alloc((PyTypeObject *)type, 0);
    Py_DECREF(type);
    if (!self) { fw_close(db); return NULL; }
    self->db = db;
    return (PyObject *)self;
}

static PyObject *core_create(PyObject *module, PyObject *args) {
    const char *name;
    fw_opts o = {0};
    if (!PyArg_ParseTuple(args, "zKILL", &name, &o.size, &o.max_objects, &o.tick_ns, &o.t0_ns)) return NULL;
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

static PyObject *store_close(Store *self, PyObject *Py_UNUSED(ignored)) {
    if (self->db) fw_close(self->db);
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

/* -- directory -------------------------------------------------------------------------------------------------- */

static PyObject *store_join(Store *self, PyObject *args) {
    const char *name;
    int participant;
    if (closed(self) || !PyArg_ParseTuple(args, "sp", &name, &participant)) return NULL;
    int r = fw_join(self->db, name, participant);
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
    return Py_BuildValue("(sLiKi)", c.name, c.pid, c.alive, c.done, c.participant);
}

static PyObject *store_n_components(Store *self, PyObject *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromUnsignedLong(fw_n_components(self->db));
}

static PyObject *store_add_schema(Store *self, PyObject *args) {
    const char *text;
    Py_ssize_t n;
    if (closed(self) || !PyArg_ParseTuple(args, "s#", &text, &n)) return NULL;
    int r = fw_schema_add(self->db, text, (uint32_t)n);
    return r < 0 ? fail(r, "add", "a schema") : PyLong_FromLong(r);
}

static PyObject *store_schema(Store *self, FAST) {
    uint32_t i, n;
    const char *text;
    NARGS(1)
    if (u32_of(args[0], &i) < 0) return NULL;
    int r = fw_schema_get(self->db, i, &text, &n);
    return r < 0 ? fail(r, "look up", "a schema") : PyUnicode_DecodeUTF8(text, (Py_ssize_t)n, "strict");
}

static PyObject *store_insert(Store *self, PyObject *args) {
    const char *name;
    fw_spec s = {0};
    if (closed(self) || !PyArg_ParseTuple(args, "sIIIIIIIIK", &name, &s.component, &s.schema, &s.size, &s.n_slots, &s.every,
                                          &s.phase, &s.flags, &s.n_causes, &s.parent)) return NULL;
    if (strlen(name) >= FW_NAME_MAX) return fail(-ENAMETOOLONG, "insert", name);
    strncpy(s.name, name, FW_NAME_MAX - 1);
    int r = fw_insert(self->db, &s);
    return r < 0 ? fail(r, "insert", name) : PyLong_FromLong(r);
}

static PyObject *store_find(Store *self, PyObject *args) {
    const char *name;
    if (closed(self) || !PyArg_ParseTuple(args, "s", &name)) return NULL;
    int r = fw_find(self->db, name);
    return r < 0 ? fail(r, "find", name) : PyLong_FromLong(r);
}

static PyObject *store_n_objects(Store *self, PyObject *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromUnsignedLong(fw_n_objects(self->db));
}

static PyObject *store_object(Store *self, FAST) {
    uint32_t i;
    fw_object o;
    NARGS(1)
    if (u32_of(args[0], &i) < 0) return NULL;
    int r = fw_object_get(self->db, i, &o);
    if (r < 0) return fail_object(self->db, r, "look up", i);
    return Py_BuildValue("(sKIIIIIIIIKKK)", o.spec.name, o.oid, o.spec.component, o.spec.schema, o.spec.size, o.spec.n_slots,
                         o.spec.every, o.spec.phase, o.spec.flags, o.spec.n_causes, o.spec.parent, o.head, o.refused);
}

/* -- writing and reading ------------------------------------------------------------------------------------------ */

static PyObject *store_write(Store *self, FAST) { /* object, payload, t_data_ns, causes */
    uint32_t object;
    fw_cause causes[FW_CAUSES_MAX];
    char *data;
    Py_ssize_t n;
    NARGS(4)
    if (u32_of(args[0], &object) < 0 || PyBytes_AsStringAndSize(args[1], &data, &n) < 0) return NULL;
    int64_t t = PyLong_AsLongLong(args[2]);
    if (t == -1 && PyErr_Occurred()) return NULL;
    int n_causes = causes_of(args[3], causes);
    if (n_causes < 0) return NULL;
    int64_t w = fw_write(self->db, object, data, (uint32_t)n, t, causes, (uint32_t)n_causes);
    return w < 0 ? fail_object(self->db, w, "write", object) : PyLong_FromLongLong(w);
}

static PyObject *store_begin(Store *self, FAST) { /* object -> writable memory of one slot, until commit */
    uint32_t object;
    void *slot;
    fw_object o;
    NARGS(1)
    if (u32_of(args[0], &object) < 0) return NULL;
    int r = fw_write_begin(self->db, object, &slot);
    if (r < 0 || (r = fw_object_get(self->db, object, &o)) < 0) return fail_object(self->db, r, "write", object);
    return PyMemoryView_FromMemory(slot, (Py_ssize_t)o.spec.size, PyBUF_WRITE);
}

static PyObject *store_commit(Store *self, FAST) { /* object, size, t_data_ns */
    uint32_t object, n;
    NARGS(3)
    if (u32_of(args[0], &object) < 0 || u32_of(args[1], &n) < 0) return NULL;
    int64_t t = PyLong_AsLongLong(args[2]);
    if (t == -1 && PyErr_Occurred()) return NULL;
    int64_t w = fw_write_commit(self->db, object, n, t, NULL, 0);
    return w < 0 ? fail_object(self->db, w, "write", object) : PyLong_FromLongLong(w);
}

static PyObject *found(Store *self, uint32_t object, int64_t w) { /* a sample, None for no write, or an exception */
    if (w == 0 || w == -EAGAIN) Py_RETURN_NONE;
    return w < 0 ? fail_object(self->db, w, "read", object) : sample_of(self->db, object, w);
}

static PyObject *store_read(Store *self, FAST) { /* object, write */
    uint32_t object;
    NARGS(2)
    if (u32_of(args[0], &object) < 0) return NULL;
    int64_t w = PyLong_AsLongLong(args[1]);
    if (w == -1 && PyErr_Occurred()) return NULL;
    return sample_of(self->db, object, w < 0 ? 0 : w);
}

static PyObject *store_visible(Store *self, FAST) { /* object, cycle */
    uint32_t object;
    NARGS(2)
    if (u32_of(args[0], &object) < 0) return NULL;
    unsigned long long cycle = PyLong_AsUnsignedLongLong(args[1]);
    if (cycle == (unsigned long long)-1 && PyErr_Occurred()) return NULL;
    return found(self, object, fw_visible(self->db, object, cycle));
}

static PyObject *store_latest(Store *self, FAST) { /* object */
    uint32_t object;
    NARGS(1)
    if (u32_of(args[0], &object) < 0) return NULL;
    for (int i = 0;; i++) { /* a flat-out writer may lap the reader now and then */
        int64_t w = fw_newest(self->db, object);
        const void *data;
        fw_info info;
        if (w > 0 && i < 100 && fw_peek(self->db, object, (uint64_t)w, &data, &info) == -ESTALE) continue;
        return found(self, object, w);
    }
}

static PyObject *store_as_of(Store *self, FAST) { /* object, t_ns -> write number, 0 for none yet */
    uint32_t object;
    NARGS(2)
    if (u32_of(args[0], &object) < 0) return NULL;
    int64_t t = PyLong_AsLongLong(args[1]);
    if (t == -1 && PyErr_Occurred()) return NULL;
    int64_t w = fw_as_of(self->db, object, t);
    if (w == -EAGAIN) w = 0;
    return w < 0 ? fail_object(self->db, w, "read", object) : PyLong_FromLongLong(w);
}

static PyObject *store_changed(Store *self, PyObject *Py_UNUSED(ignored)) { /* [(object, *sample)] of the latest tick */
    if (closed(self)) return NULL;
    PyObject *list = PyList_New(0);
    uint32_t n = list ? fw_n_objects(self->db) : 0;
    for (uint32_t i = 0; i < n; i++) {
        int64_t w = fw_changed(self->db, i);
        if (w == 0) continue;
        PyObject *sample = w < 0 ? fail_object(self->db, w, "read", i) : sample_of(self->db, i, w);
        PyObject *pair = sample ? Py_BuildValue("(IN)", i, sample) : NULL;
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

static PyObject *store_cycle(Store *self, void *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromUnsignedLongLong(fw_cycle(self->db));
}
static PyObject *store_now_ns(Store *self, void *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromLongLong(fw_now_ns(self->db));
}
static PyObject *store_tick_ns(Store *self, void *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromLongLong(fw_tick_ns(self->db));
}
static PyObject *store_t0_ns(Store *self, void *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromLongLong(fw_t0_ns(self->db));
}
static PyObject *store_id(Store *self, void *Py_UNUSED(ignored)) {
    return closed(self) ? NULL : PyLong_FromUnsignedLongLong(fw_store_id(self->db));
}

static PyObject *store_take_clock(Store *self, PyObject *Py_UNUSED(ignored)) {
    if (closed(self)) return NULL;
    int r = fw_clock_take(self->db);
    if (r < 0) return fail(r, "take", "the clock");
    Py_RETURN_NONE;
}

static PyObject *store_done(Store *self, FAST) { /* component, cycle */
    uint32_t component;
    NARGS(2)
    if (u32_of(args[0], &component) < 0) return NULL;
    unsigned long long cycle = PyLong_AsUnsignedLongLong(args[1]);
    if (cycle == (unsigned long long)-1 && PyErr_Occurred()) return NULL;
    int r = fw_done(self->db, component, cycle);
    if (r < 0) return fail(r, "report done", "a component");
    Py_RETURN_NONE;
}

typedef int64_t (*wait_call)(fw_db *, uint64_t, int64_t);
static int64_t wait_done(fw_db *db, uint64_t n, int64_t timeout) { return fw_wait_done(db, n, timeout); }
static int64_t wait_object(fw_db *db, uint64_t n, int64_t timeout) { return fw_wait_object(db, (uint32_t)n, timeout); }

/* Waits without the interpreter's lock; Ctrl-C ends it. Returns the result, or None after the timeout. */
static PyObject *waiting(Store *self, FAST, wait_call call, const char *subject) {
    NARGS(2)
    unsigned long long n = PyLong_AsUnsignedLongLong(args[0]);
    if (n == (unsigned long long)-1 && PyErr_Occurred()) return NULL;
    int64_t timeout = PyLong_AsLongLong(args[1]);
    if (timeout == -1 && PyErr_Occurred()) return NULL;
    int64_t deadline = fw_platform_monotonic_ns() + timeout, r;
    for (;;) { /* in slices, so that a signal just before the system call is noticed too */
        int64_t left = deadline - fw_platform_monotonic_ns(), slice = left < 100000000 ? left : 100000000;
        Py_BEGIN_ALLOW_THREADS
        r = call(self->db, n, slice);
        Py_END_ALLOW_THREADS
        if (PyErr_CheckSignals() < 0) return NULL;
        if (r != -EINTR && (r != -ETIMEDOUT || slice == left)) break;
    }
    if (r == -ETIMEDOUT) Py_RETURN_NONE;
    return r < 0 ? fail(r, "wait for", subject) : PyLong_FromLongLong(r);
}

static PyObject *store_wait_cycle(Store *self, FAST) { return waiting(self, args, nargs, fw_wait_cycle, "a cycle"); }
static PyObject *store_wait_done(Store *self, FAST) { return waiting(self, args, nargs, wait_done, "the participants"); }
static PyObject *store_wait_object(Store *self, FAST) { return waiting(self, args, nargs, wait_object, "an object"); }

/* -- module ------------------------------------------------------------------------------------------------------- */

#define METHOD(name, flags) {#name, (PyCFunction)(void (*)(void))store_##name, flags, NULL}
static PyMethodDef methods[] = {
    METHOD(close, METH_NOARGS), METHOD(save, METH_NOARGS), METHOD(restore, METH_O), METHOD(join, METH_VARARGS),
    METHOD(leave, METH_FASTCALL), METHOD(component, METH_FASTCALL), METHOD(n_components, METH_NOARGS),
    METHOD(add_schema, METH_VARARGS), METHOD(schema, METH_FASTCALL), METHOD(insert, METH_VARARGS), METHOD(find, METH_VARARGS),
    METHOD(n_objects, METH_NOARGS), METHOD(object, METH_FASTCALL), METHOD(write, METH_FASTCALL), METHOD(begin, METH_FASTCALL),
    METHOD(commit, METH_FASTCALL), METHOD(read, METH_FASTCALL), METHOD(visible, METH_FASTCALL), METHOD(latest, METH_FASTCALL),
    METHOD(as_of, METH_FASTCALL), METHOD(changed, METH_NOARGS), METHOD(tick, METH_NOARGS), METHOD(take_clock, METH_NOARGS),
    METHOD(done, METH_FASTCALL), METHOD(wait_cycle, METH_FASTCALL), METHOD(wait_done, METH_FASTCALL),
    METHOD(wait_object, METH_FASTCALL), {NULL, NULL, 0, NULL}};

#define GETTER(name) {#name, (getter)store_##name, NULL, NULL, NULL}
static PyGetSetDef getters[] = {GETTER(cycle), GETTER(now_ns), GETTER(tick_ns), GETTER(t0_ns), GETTER(id), {NULL, NULL, NULL, NULL, NULL}};

static PyType_Slot slots[] = {{Py_tp_dealloc, (void *)store_dealloc}, {Py_tp_methods, methods}, {Py_tp_getset, getters}, {0, NULL}};
static PyType_Spec spec = {"rtdb._core.Store", sizeof(Store), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, slots};

static PyMethodDef functions[] = {{"create", core_create, METH_VARARGS, NULL}, {"attach", core_attach, METH_VARARGS, NULL}, {NULL, NULL, 0, NULL}};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "rtdb._core", "The store's C core.", -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__core(void) {
    PyObject *m = PyModule_Create(&module);
    PyObject *type = m ? PyType_FromSpec(&spec) : NULL;
    if (!type || PyModule_AddObjectRef(m, "Store", type) < 0 ||
        PyModule_AddStringConstant(m, "SOURCE_HASH", FW_SOURCE_HASH) < 0) { Py_XDECREF(type); Py_XDECREF(m); return NULL; }
    Py_DECREF(type);
    return m;
}
