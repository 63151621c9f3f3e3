// Enumerations and sizes that C++ and Python share: engine/enums.py has the same, and compares the two at load time.
#pragma once

namespace tc {

// What a field of a program holds; see engine/enums.py.
#define TC_FIELD_KIND(X)                                                                                             \
    X(constant, 0) X(parameter, 1) X(state, 2) X(next, 3) X(temporary, 4) X(recorded, 5) X(per_substep, 6) X(sum, 7) \
    X(nodes, 8) X(points, 9)
// Instructions of a loop.
#define TC_OPCODE(X) X(load, 0) X(call, 1) X(add, 2) X(store, 3) X(lookup, 4) X(p2g, 5) X(g2p, 6)
// Factors of a transfer between points and nodes: slopes of the weights, or weights times arms.
#define TC_TRANSFER_BASIS(X) X(gradient, 0) X(affine, 1)
// Linear operator of a stencil.
#define TC_STENCIL_FORM(X) X(plain, 0) X(transposed, 1) X(symmetric, 2)
// First row table of each group that the contact search lists: tables of active points, of just activated, of inactive.
#define TC_CONTACT_TABLE(X) \
    X(corners, 0) X(triangle, 3) X(point, 4) X(place, 5) X(nodes, 6) X(activated, 7) X(inactive, 13)
// Which contact points a loop runs on.
#define TC_CONTACT_COUNT(X) X(active, 0) X(activated, 1) X(inactive, 2)
// What a run of a program computes.
#define TC_RUN_MODE(X) X(values, 0) X(adjoints, 1) X(tangents, 2)
// Operations of a kernel; a name with c has one constant operand.
#define TC_TAPE_OP(X)                                                                                               \
    X(input, 0) X(constant, 1) X(add, 2) X(sub, 3) X(mul, 4) X(div, 5) X(addc, 6) X(rsubc, 7) X(mulc, 8) X(rdivc, 9) \
    X(neg, 10) X(sqrt, 11) X(exp, 12) X(expm1, 13) X(atan2, 14) X(abs, 15) X(at_least, 16) X(at_most, 17)           \
    X(less, 18) X(lessc, 19) X(cless, 20) X(select, 21) X(detach, 22)

#define TC_MEMBER(name, value) name = value,
enum class FieldKind : int { TC_FIELD_KIND(TC_MEMBER) };
enum class Opcode : int { TC_OPCODE(TC_MEMBER) };
enum class TransferBasis : int { TC_TRANSFER_BASIS(TC_MEMBER) };
enum class StencilForm : int { TC_STENCIL_FORM(TC_MEMBER) };
enum class RunMode : int { TC_RUN_MODE(TC_MEMBER) };
enum class TapeOp : unsigned char { TC_TAPE_OP(TC_MEMBER) };
namespace contact_table { enum : int { TC_CONTACT_TABLE(TC_MEMBER) count = 19 }; }
namespace contact_count { enum : int { TC_CONTACT_COUNT(TC_MEMBER) count = 3 }; }
#undef TC_MEMBER

// Sizes: the name in the table, the constant, its value.
#define TC_SIZE(X)                                                                                          \
    X(item_row, ITEM_ROW, -1)                 /* in the place of a table: item i reads and writes row i */  \
    X(single_row, SINGLE_ROW, -2)             /* all items read, or add to, row 0 */                        \
    X(contact_rows, CONTACT_ROWS, -3)         /* and below: rows that the contact search lists */           \
    X(transfer_shares, TRANSFER_SHARES, 16)   /* numbers of a point: (mass or nothing, vector) four times */ \
    X(patch_triangles, PATCH_TRIANGLES, 8)    /* triangles of a patch of the contact search */              \
    X(max_lanes, MAX_LANES, 16)               /* numbers of the widest pack */
#define TC_CONSTANT(name, constant, value) constexpr int constant = value;
TC_SIZE(TC_CONSTANT)
#undef TC_CONSTANT

#define TC_TEXT(name, value) " " #name "=" #value
#define TC_SIZE_TEXT(name, constant, value) " " #name "=" #value
// A line for each enumeration: its name, then member=value of all members.
inline constexpr const char* ENUMS =
    "FieldKind" TC_FIELD_KIND(TC_TEXT) "\nOpcode" TC_OPCODE(TC_TEXT) "\nTransferBasis" TC_TRANSFER_BASIS(TC_TEXT)
    "\nStencilForm" TC_STENCIL_FORM(TC_TEXT) "\nContactTable" TC_CONTACT_TABLE(TC_TEXT)
    "\nContactCount" TC_CONTACT_COUNT(TC_TEXT) "\nRunMode" TC_RUN_MODE(TC_TEXT) "\nTapeOp" TC_TAPE_OP(TC_TEXT)
    "\nSizes" TC_SIZE(TC_SIZE_TEXT);
#undef TC_TEXT
#undef TC_SIZE_TEXT

}  // namespace tc
