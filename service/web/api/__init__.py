"""Routes of `/api/v1` for stored data, decisions on proposals, and orders to push or roll back a table.

The core carries out the orders, and only it moves axes. (Jobs: `abbe.service.web.jobs`.)
"""
