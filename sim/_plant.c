/* _plant.c - the Python face of fw_plant.h: the type Plant, and the functions of trig.h. It adds types and exceptions, never
 * logic. Limited API of CPython 3.11: one binary serves every later version. */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <string.h>

#undef Py_RETURN_NONE /* the headers of 3.12 and later take None for immortal, and in 3.11 it is not */
#define Py_RETURN_NONE return Py_NewRef(Py_None)

#include "kernel/fw_plant.h"
#include "kernel/trig.h"

#ifndef FW_SOURCE_HASH
#define FW_SOURCE_HASH ""
#endif

enum {
    FIELDS = sizeof(fw_cart) / sizeof(double),
    COEFFICIENTS = sizeof(fw_coefficients) / sizeof(double),
    DEMAND = sizeof(fw_demand) / sizeof(double),
    GROUND = sizeof(fw_ground) / sizeof(double),
};

typedef struct {
    PyObject_HEAD
    fw_plant *plant; /* one block, as long as the object lives: views into it hold a reference */
    fw_params *params;
    Py_ssize_t size, shape[2], strides[2];
} Plant;

#define FAST PyObject *const *args, Py_ssize_t nargs
#define NARGS(n) \
    if (nargs != (n)) return PyErr_Format(PyExc_TypeError, "%s takes %d arguments, got %zd", __func__, n, nargs);

/* -- conversions: 0, or -1 with an exception ---------------------------------------------------------------------- */

static int u64_of(PyObject *o, uint64_t *out) {
    *out = PyLong_AsUnsignedLongLong(o);
    return *out == (uint64_t)-1 && PyErr_Occurred() ? -1 : 0;
}

static Py_ssize_t length_of(PyObject *tuple, const char *what) {
    if (PyTuple_Check(tuple)) return PyTuple_Size(tuple);
    PyErr_Format(PyExc_TypeError, "%s: expected a tuple", what);
    return -1;
}

static int length_is(PyObject *tuple, Py_ssize_t n, const char *what) {
    Py_ssize_t length = length_of(tuple, what);
    if (length >= 0 && length != n) PyErr_Format(PyExc_ValueError, "%s: %zd of them, expected %zd", what, length, n);
    return length == n ? 0 : -1;
}

static int doubles_of(PyObject *const *args, Py_ssize_t n, double *out) {
    for (Py_ssize_t i = 0; i < n; i++) {
        out[i] = PyFloat_AsDouble(args[i]);
        if (out[i] == -1.0 && PyErr_Occurred()) return -1;
    }
    return 0;
}

/* the first n values of a tuple */
static int row_of(PyObject *tuple, Py_ssize_t n, double *out) {
    for (Py_ssize_t i = 0; i < n; i++) {
        PyObject *o = PyTuple_GetItem(tuple, i);
        if (!o || doubles_of(&o, 1, &out[i]) < 0) return -1;
    }
    return 0;
}

static int delay_of(PyObject *tuple, Py_ssize_t i, uint32_t *out) {
    PyObject *o = PyTuple_GetItem(tuple, i);
    long delay = o ? PyLong_AsLong(o) : -1;
    if (delay == -1 && PyErr_Occurred()) return -1;
    if (delay < 0 || delay >= (long)FW_DEPTH_MAX) {
        PyErr_Format(PyExc_ValueError, "a dead time of %ld steps, expected 0 to %d", delay, (int)FW_DEPTH_MAX - 1);
        return -1;
    }
    *out = (uint32_t)delay;
    return 0;
}

static int params_of(PyObject *tuple, fw_params *out) {
    if (length_is(tuple, COEFFICIENTS + 3, "the parameters of a cart") < 0 || row_of(tuple, COEFFICIENTS, (double *)&out->k) < 0) return -1;
    if (delay_of(tuple, COEFFICIENTS, &out->steer_delay) < 0) return -1;
    if (delay_of(tuple, COEFFICIENTS + 1, &out->brake_delay) < 0) return -1;
    return delay_of(tuple, COEFFICIENTS + 2, &out->drive_delay);
}

/* a tuple of n doubles, the last one as a bool; NULL with an exception */
static PyObject *tuple_of(const double *row, Py_ssize_t n) {
    PyObject *tuple = PyTuple_New(n);
    for (Py_ssize_t i = 0; tuple && i < n; i++) {
        PyObject *o = i < n - 1 ? PyFloat_FromDouble(row[i]) : PyBool_FromLong(row[i] != 0.0);
        if (!o) { Py_DECREF(tuple); return NULL; }
        PyTuple_SetItem(tuple, i, o);
    }
    return tuple;
}

static int cart_of(Plant *self, PyObject *o, uint64_t *cart) {
    if (u64_of(o, cart) < 0) return -1;
    if (*cart < self->plant->n) return 0;
    PyErr_Format(PyExc_IndexError, "cart %llu of %llu", (unsigned long long)*cart, (unsigned long long)self->plant->n);
    return -1;
}

/* -- a plant -------------------------------------------------------------------------------------------------------- */

static PyObject *plant_new(PyTypeObject *type, PyObject *args, PyObject *kwargs) { /* ((29 coefficients, 3 delays), ...) */
    PyObject *rows;
    if (kwargs && PyDict_Size(kwargs)) return PyErr_Format(PyExc_TypeError, "Plant takes no keywords");
    if (!PyArg_ParseTuple(args, "O", &rows)) return NULL;
    Py_ssize_t n = length_of(rows, "the rows of parameters");
    if (n < 0) return NULL;
    if (n == 0) return PyErr_Format(PyExc_ValueError, "a plant of no carts, expected at least one row of parameters");
    allocfunc alloc = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    Plant *self = (Plant *)alloc(type, 0);
    if (!self) return NULL;
    self->params = PyMem_Calloc((size_t)n, sizeof(fw_params));
    if (!self->params) { Py_DECREF(self); return PyErr_NoMemory(); }
    uint32_t longest = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        fw_params *p = &self->params[i];
        if (params_of(PyTuple_GetItem(rows, i), p) < 0) { Py_DECREF(self); return NULL; }
        longest = p->steer_delay > longest ? p->steer_delay : longest;
        longest = p->brake_delay > longest ? p->brake_delay : longest;
        longest = p->drive_delay > longest ? p->drive_delay : longest;
    }
    size_t size = fw_plant_size((uint64_t)n, 1 + longest);
    self->plant = size ? PyMem_Malloc(size) : NULL;
    if (!self->plant) { Py_DECREF(self); return PyErr_NoMemory(); }
    fw_plant_init(self->plant, (uint64_t)n, 1 + longest);
    self->size = (Py_ssize_t)size;
    self->shape[0] = n;
    self->shape[1] = FIELDS;
    self->strides[0] = sizeof(fw_cart);
    self->strides[1] = sizeof(double);
    return (PyObject *)self;
}

static void plant_dealloc(Plant *self) {
    PyTypeObject *type = Py_TYPE((PyObject *)self);
    PyMem_Free(self->plant);
    PyMem_Free(self->params);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(self);
    Py_DECREF(type);
}

static PyObject *stepped(uint64_t beyond) {
    if (!beyond) Py_RETURN_NONE;
    return PyErr_Format(PyExc_ValueError, "%llu carts stand still: their yaw is beyond %d rad", (unsigned long long)beyond,
                        (int)FW_YAW_MAX);
}

static PyObject *plant_step(Plant *self, FAST) { /* 4 of the demand, 3 of the ground, steps: one cart */
    double values[DEMAND + GROUND];
    uint64_t steps;
    NARGS(DEMAND + GROUND + 1)
    if (self->plant->n != 1)
        return PyErr_Format(PyExc_ValueError, "step is for one cart, this plant has %zd: use step_each", self->shape[0]);
    if (doubles_of(args, DEMAND + GROUND, values) < 0 || u64_of(args[DEMAND + GROUND], &steps) < 0) return NULL;
    fw_demand demand = {values[0], values[1], values[2], values[3]};
    fw_ground ground = {values[4], values[5], values[6]};
    return stepped(fw_plant_step(self->plant, self->params, &demand, &ground, steps));
}

/* n rows of doubles, to be released; -1 with an exception */
static int rows_of(PyObject *o, Py_buffer *view, Py_ssize_t n, Py_ssize_t columns, const char *what) {
    if (PyObject_GetBuffer(o, view, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS) < 0) return -1;
    int doubles = view->format && strcmp(view->format, "d") == 0 && (uintptr_t)view->buf % sizeof(double) == 0;
    if (doubles && view->len == n * columns * (Py_ssize_t)sizeof(double)) return 0;
    PyErr_Format(PyExc_ValueError, "%s: %zd bytes of format %s, expected (%zd, %zd) of d, aligned", what, view->len,
                 view->format ? view->format : "B", n, columns);
    PyBuffer_Release(view);
    return -1;
}

static PyObject *plant_step_each(Plant *self, FAST) { /* demands (n, 4), grounds (n, 3), steps */
    Py_buffer demands, grounds;
    uint64_t steps;
    NARGS(3)
    if (u64_of(args[2], &steps) < 0 || rows_of(args[0], &demands, self->shape[0], DEMAND, "demands") < 0) return NULL;
    if (rows_of(args[1], &grounds, self->shape[0], GROUND, "grounds") < 0) { PyBuffer_Release(&demands); return NULL; }
    uint64_t beyond = fw_plant_step(self->plant, self->params, demands.buf, grounds.buf, steps);
    PyBuffer_Release(&grounds);
    PyBuffer_Release(&demands);
    return stepped(beyond);
}

static PyObject *plant_cart(Plant *self, PyObject *cart) { /* the state, in the order of CartState */
    uint64_t i;
    if (cart_of(self, cart, &i) < 0) return NULL;
    return tuple_of((const double *)&fw_plant_carts(self->plant)[i], FIELDS);
}

static PyObject *plant_pending(Plant *self, PyObject *cart) { /* ((4 of a demand), ...), oldest first */
    uint64_t i, depth = self->plant->depth;
    if (cart_of(self, cart, &i) < 0) return NULL;
    PyObject *all = PyTuple_New((Py_ssize_t)depth);
    for (uint64_t j = 0; all && j < depth; j++) {
        const fw_demand *demand = &fw_plant_pending(self->plant, i)[(self->plant->newest + 1 + j) % depth];
        PyObject *one = tuple_of((const double *)demand, DEMAND);
        if (!one) { Py_DECREF(all); return NULL; }
        PyTuple_SetItem(all, (Py_ssize_t)j, one);
    }
    return all;
}

static PyObject *plant_put(Plant *self, FAST) { /* cart, its state, its pending demands: all of them, or nothing changes */
    uint64_t i, depth = self->plant->depth;
    fw_cart row;
    NARGS(3)
    if (cart_of(self, args[0], &i) < 0 || length_is(args[1], FIELDS, "the values of a state") < 0) return NULL;
    if (row_of(args[1], FIELDS, (double *)&row) < 0 || length_is(args[2], (Py_ssize_t)depth, "pending demands") < 0) return NULL;
    fw_demand *pending = PyMem_Calloc(depth, sizeof *pending);
    if (!pending) return PyErr_NoMemory();
    for (uint64_t j = 0; j < depth; j++) {
        PyObject *demand = PyTuple_GetItem(args[2], (Py_ssize_t)j);
        double *values = (double *)&pending[(self->plant->newest + 1 + j) % depth];
        if (length_is(demand, DEMAND, "the values of a demand") < 0 || row_of(demand, DEMAND, values) < 0) { PyMem_Free(pending); return NULL; }
    }
    fw_plant_carts(self->plant)[i] = row;
    memcpy(fw_plant_pending(self->plant, i), pending, depth * sizeof *pending);
    PyMem_Free(pending);
    Py_RETURN_NONE;
}

static PyObject *plant_save(Plant *self, PyObject *Py_UNUSED(ignored)) {
    return PyBytes_FromStringAndSize((const char *)self->plant, self->size);
}

static PyObject *plant_restore(Plant *self, PyObject *image) {
    char *data;
    Py_ssize_t size;
    fw_plant head;
    if (PyBytes_AsStringAndSize(image, &data, &size) < 0) return NULL;
    if (size == self->size) memcpy(&head, data, sizeof head);
    if (size != self->size || head.magic != FW_PLANT_MAGIC || head.n != self->plant->n || head.depth != self->plant->depth ||
        head.newest >= head.depth)
        return PyErr_Format(PyExc_ValueError, "not an image of %zd carts with %llu pending demands each", self->shape[0],
                            (unsigned long long)self->plant->depth);
    memcpy(self->plant, data, (size_t)size);
    Py_RETURN_NONE;
}

/* memoryview(plant): the states, (n, 17) doubles, writable */
static int plant_getbuffer(Plant *self, Py_buffer *view, int flags) {
    Py_INCREF((PyObject *)self);
    *view = (Py_buffer){
        .obj = (PyObject *)self,
        .buf = fw_plant_carts(self->plant),
        .len = self->shape[0] * self->strides[0],
        .itemsize = sizeof(double),
        .format = flags & PyBUF_FORMAT ? "d" : NULL,
        .ndim = 2,
        .shape = flags & PyBUF_ND ? self->shape : NULL,
        .strides = (flags & PyBUF_STRIDES) == PyBUF_STRIDES ? self->strides : NULL,
    };
    return 0;
}

static PyObject *plant_n(Plant *self, void *Py_UNUSED(ignored)) { return PyLong_FromUnsignedLongLong(self->plant->n); }
static PyObject *plant_depth(Plant *self, void *Py_UNUSED(ignored)) { return PyLong_FromUnsignedLongLong(self->plant->depth); }

/* -- trig.h --------------------------------------------------------------------------------------------------------- */

static PyObject *module_sincos(PyObject *Py_UNUSED(module), PyObject *x) {
    double value, sine, cosine;
    if (doubles_of(&x, 1, &value) < 0) return NULL;
    fw_sincos(value, &sine, &cosine);
    return Py_BuildValue("(dd)", sine, cosine);
}

static PyObject *module_atan(PyObject *Py_UNUSED(module), PyObject *x) {
    double value;
    return doubles_of(&x, 1, &value) < 0 ? NULL : PyFloat_FromDouble(fw_atan(value));
}

/* -- module --------------------------------------------------------------------------------------------------------- */

#define METHOD(name, flags) {#name, (PyCFunction)(void (*)(void))plant_##name, flags, NULL}
static PyMethodDef methods[] = {METHOD(step, METH_FASTCALL), METHOD(step_each, METH_FASTCALL), METHOD(cart, METH_O),
                                METHOD(pending, METH_O), METHOD(put, METH_FASTCALL), METHOD(save, METH_NOARGS),
                                METHOD(restore, METH_O), {NULL, NULL, 0, NULL}};
static PyGetSetDef getters[] = {{"n", (getter)plant_n, NULL, NULL, NULL}, {"depth", (getter)plant_depth, NULL, NULL, NULL},
                                {NULL, NULL, NULL, NULL, NULL}};
static PyType_Slot slots[] = {{Py_tp_new, (void *)plant_new}, {Py_tp_dealloc, (void *)plant_dealloc}, {Py_tp_methods, methods},
                              {Py_tp_getset, getters}, {Py_bf_getbuffer, (void *)plant_getbuffer}, {0, NULL}};
static PyType_Spec spec = {"sim._plant.Plant", sizeof(Plant), 0, Py_TPFLAGS_DEFAULT, slots};

static PyMethodDef functions[] = {{"sincos", module_sincos, METH_O, NULL}, {"atan", module_atan, METH_O, NULL}, {NULL, NULL, 0, NULL}};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "sim._plant", "The plant's C kernel.", -1, functions, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__plant(void) {
    PyObject *m = PyModule_Create(&module), *type = m ? PyType_FromSpec(&spec) : NULL;
    if (!type || PyModule_AddObjectRef(m, "Plant", type) < 0 || PyModule_AddStringConstant(m, "SOURCE_HASH", FW_SOURCE_HASH) < 0)
        Py_CLEAR(m);
    Py_XDECREF(type);
    return m;
}
