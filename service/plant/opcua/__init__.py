"""An OPC UA server that only shows. The only package that knows asyncua, which is an extra (``pip install 'abbe[opcua]'``)."""
