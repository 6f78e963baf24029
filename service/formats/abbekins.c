/* SPDX-License-Identifier: Apache-2.0 OR GPL-2.0-or-later
 *
 * Kinematics of a three-axis machine whose deviations are known: joint = position + weight * correction(position).
 * The correction, mm, is trilinear between the nodes of a grid, and beyond it that of the nearest face. Written by Abbe.
 *
 *   sudo halcompile --install abbekins.c
 *   in the .ini:  [KINS] KINEMATICS = abbekins    JOINTS = 3    and joint limits 1 mm wider than those of the axes
 *   in the .hal, behind motion-controller:        addf abbekins.update servo-thread
 *   in force:     setp abbekins.weight 1          back to nothing: setp abbekins.weight 0
 *
 * The weight moves by at most 1 per second; change it while the machine stands. It is 0 after a start.
 */
#include "rtapi.h"
#include "rtapi_app.h"
#include "rtapi_math.h"
#include "hal.h"
#include "kinematics.h"

#define PASSES 6 /* of the inverse: each gains more than three digits */

static const int COUNT[3] = {@COUNT@};
static const double FIRST[3] = {@FIRST@}, STEP[3] = {@STEP@};
static const double TABLE[][3] = { /* X, Y, Z of each node; Z changes fastest, then Y */
@TABLE@
};

struct pins {
    hal_float_t *weight, *applied;
};
static struct pins *pins;
static int comp_id;

static void correction(const double at[3], double out[3])
{
    int cell[3], corner, k;
    double share[3];

    for (k = 0; k < 3; k++) {
        double place = (at[k] - FIRST[k]) / STEP[k];
        place = place > 0.0 ? place : 0.0; /* also for what is no number */
        if (place > COUNT[k] - 1) place = COUNT[k] - 1;
        cell[k] = (int)place < COUNT[k] - 2 ? (int)place : COUNT[k] - 2;
        share[k] = place - cell[k];
        out[k] = 0.0;
    }
    for (corner = 0; corner < 8; corner++) {
        int there[3] = {corner >> 2, (corner >> 1) & 1, corner & 1};
        double part = *pins->applied;
        int node = 0;
        for (k = 0; k < 3; k++) {
            part *= there[k] ? share[k] : 1.0 - share[k];
            node = node * COUNT[k] + cell[k] + there[k];
        }
        for (k = 0; k < 3; k++) out[k] += part * TABLE[node][k];
    }
}

static void update(void *arg, long period)
{
    double most = period * 1e-9, wanted = *pins->weight, change;

    (void)arg;
    wanted = wanted > 0.0 ? (wanted < 1.0 ? wanted : 1.0) : 0.0;
    change = wanted - *pins->applied;
    *pins->applied += change > most ? most : (change < -most ? -most : change);
}

int kinematicsInverse(const EmcPose *pos, double *joints, const KINEMATICS_INVERSE_FLAGS *iflags, KINEMATICS_FORWARD_FLAGS *fflags)
{
    double at[3] = {pos->tran.x, pos->tran.y, pos->tran.z}, add[3];
    int k;

    (void)iflags;
    (void)fflags;
    correction(at, add);
    for (k = 0; k < 3; k++) joints[k] = at[k] + add[k];
    return 0;
}

int kinematicsForward(const double *joints, EmcPose *pos, const KINEMATICS_FORWARD_FLAGS *fflags, KINEMATICS_INVERSE_FLAGS *iflags)
{
    double at[3] = {joints[0], joints[1], joints[2]}, add[3];
    int pass, k;

    (void)fflags;
    (void)iflags;
    for (pass = 0; pass < PASSES; pass++) {
        correction(at, add);
        for (k = 0; k < 3; k++) at[k] = joints[k] - add[k];
    }
    pos->tran.x = at[0];
    pos->tran.y = at[1];
    pos->tran.z = at[2];
    pos->a = pos->b = pos->c = pos->u = pos->v = pos->w = 0.0;
    return 0;
}

KINEMATICS_TYPE kinematicsType(void) { return KINEMATICS_BOTH; }

#ifdef KINS_NOT_SWITCHABLE
KINS_NOT_SWITCHABLE
#endif
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsForward);
EXPORT_SYMBOL(kinematicsInverse);
MODULE_LICENSE("GPL");

int rtapi_app_main(void)
{
    comp_id = hal_init("abbekins");
    if (comp_id < 0) return comp_id;
    pins = hal_malloc(sizeof(*pins));
    if (pins == NULL || hal_pin_float_new("abbekins.weight", HAL_IN, &pins->weight, comp_id) < 0
        || hal_pin_float_new("abbekins.applied", HAL_OUT, &pins->applied, comp_id) < 0
        || hal_export_funct("abbekins.update", update, NULL, 1, 0, comp_id) < 0) {
        hal_exit(comp_id);
        return -1;
    }
    *pins->weight = *pins->applied = 0.0;
    hal_ready(comp_id);
    return 0;
}

void rtapi_app_exit(void) { hal_exit(comp_id); }
