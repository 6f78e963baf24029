"""A read-only OPC UA server. The only package that imports asyncua, which is an extra (``pip install 'abbe[opcua]'``)."""
